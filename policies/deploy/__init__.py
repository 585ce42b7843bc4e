"""Run a policy on a robot: controller, observers, filters, logs."""
