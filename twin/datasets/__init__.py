"""Data sets of stereo images: their formats, read and written, and what all formats have in common."""
