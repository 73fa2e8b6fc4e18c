"""Reference for the light model: Monte Carlo simulation of the radiance of a pixel, with any order of scattering."""
