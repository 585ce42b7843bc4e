"""Reading of files that may be hostile: content, budgets, numbers, tables."""
