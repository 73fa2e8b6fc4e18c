"""Products of elevation maps and the change between two of them, with their uncertainty."""
