"""Reproduction of experiments of Negahdaripour & Madjidi (2003)."""
