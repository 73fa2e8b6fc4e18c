"""Replay of recorded stereo data sets: readers, calibration files, rectification, frames, preview, run folder."""
