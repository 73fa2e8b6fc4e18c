"""Online pose filter, and the navigation sensors that aid it and the global alignment."""
