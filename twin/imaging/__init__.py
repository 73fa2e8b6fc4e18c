"""Image formation: from albedo and depth of the floor to the digital image of a camera."""
