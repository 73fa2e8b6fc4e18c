"""Experiments of `twin reproduce`: those of Negahdaripour & Madjidi (2003), and validation of the light model."""
