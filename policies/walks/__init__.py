"""Walks of policies in the simulator: conditions, rollouts and tracking errors."""
