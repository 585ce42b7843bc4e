"""Analysis of trained policies: rhythm, robustness, what they make of their servos."""
