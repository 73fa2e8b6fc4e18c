"""Reproduction of experiments of the paper (Negahdaripour & Madjidi 2003)."""
