"""Commands that make recordings and examine them."""
