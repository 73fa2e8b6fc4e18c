"""Image formation: from albedo and range of the floor to the digital image of a camera."""
