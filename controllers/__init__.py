"""Where to go and how to get there."""
