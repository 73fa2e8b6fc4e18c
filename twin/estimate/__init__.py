"""The method: motion, positioning, alignment and mapping from frames alone."""
