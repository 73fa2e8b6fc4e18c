"""Measurements from images: stereo, matching, two-view motion, frame-to-frame motion, mosaic."""
