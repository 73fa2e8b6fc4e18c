"""Kalman depth filter, elevation map and orthomosaic."""
