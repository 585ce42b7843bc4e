"""What every room shares: the joints' names, the errors users see, and how files are written."""
