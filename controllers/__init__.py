"""Survey planning and vehicle control."""
