"""Reproduction of the turbidity figure of Negahdaripour & Madjidi (2003), and validation of the light model."""
