"""Many surveys at once: which ones, on which machines, and what they say together."""
