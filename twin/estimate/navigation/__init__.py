"""The online pose filter and the navigation sensors that aid it."""
