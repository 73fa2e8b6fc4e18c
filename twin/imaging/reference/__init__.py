"""Reference for the light model: a Monte Carlo of the radiance of a pixel, with any order of scattering."""
