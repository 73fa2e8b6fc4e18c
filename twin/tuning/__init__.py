"""Search for a survey plan with the surrogate, verified by rendered surveys."""
