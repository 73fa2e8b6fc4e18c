"""Commands that a person meets: console, doctor, plan, look."""
