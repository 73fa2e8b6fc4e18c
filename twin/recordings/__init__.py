"""Recorded stereo data sets: rectification, frames, aiding, and their replay by the estimators."""
