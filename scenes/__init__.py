"""The world: vehicle, rig, lamps, water, missions, and the builder that turns them into a MuJoCo model."""
