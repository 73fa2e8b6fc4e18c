"""Online pose filter, and models of the navigation sensors that aid the filter and the global alignment."""
