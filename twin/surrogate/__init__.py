"""Surrogate surveys: measurements are sampled from a fitted error model instead of estimated from rendered images."""
