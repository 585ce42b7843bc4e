"""Commands that present results and convert them for other programs."""
