"""Objects on the sea floor: their meshes, levels of detail and positions."""
