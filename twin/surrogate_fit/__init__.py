"""Fit of the surrogate's error model to rendered surveys."""
