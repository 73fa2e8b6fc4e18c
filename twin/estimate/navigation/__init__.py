"""Dead reckoning, the online pose filter, and factors of the navigation sensors for the global alignment."""
