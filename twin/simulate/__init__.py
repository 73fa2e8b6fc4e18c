"""Physics of the vehicle in water."""
