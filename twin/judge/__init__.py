"""Comparison of the estimates with the truth: numbers only, no figures and no text."""
