"""A simulation-first digital twin of an underwater stereo survey."""
