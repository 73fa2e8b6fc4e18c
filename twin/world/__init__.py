"""Left of the wall: the mission, the simulated world, its truth, and the pilot."""
