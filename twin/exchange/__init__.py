"""Reading recorded data, writing what other tools open."""
