"""The estimate against the truth."""
