"""Light in the water: lamps, daylight, scattering, caustics, shadows."""
