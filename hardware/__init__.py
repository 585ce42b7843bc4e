"""Move real servos safely and read them honestly."""
