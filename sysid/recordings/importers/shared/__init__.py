"""What importers share: rows and budgets, options, times, units, and held commands."""
