"""pupper-sysid: measure a cheap servo, get a simulator that moves like it."""
