"""The mission, the simulated world, its ground truth, and the pilot. Estimators do not import this package."""
