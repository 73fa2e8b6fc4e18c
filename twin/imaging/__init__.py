"""From albedo and range to what the camera sees."""
