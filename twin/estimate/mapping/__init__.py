"""The Kalman depth filter and the elevation map."""
