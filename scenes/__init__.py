"""Vehicle parameters, the builder of the MuJoCo scene model, and the scenario files."""
