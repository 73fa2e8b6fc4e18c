"""Vehicle parameters, the builder of the MuJoCo model of the vehicle, and the scenario files."""
