"""The sea floor as numbers."""
