"""What the light falls on: floor and objects as seen by a pixel."""
