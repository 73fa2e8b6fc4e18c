"""What `twin export` does: contents of a run folder, and exact truth rendered again at its poses."""
