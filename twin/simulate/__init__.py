"""Physics of the vehicle in water, and its navigation sensors."""
