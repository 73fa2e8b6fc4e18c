"""User-facing parts of the command line: terminal output, machine check, survey plan, camera view."""
