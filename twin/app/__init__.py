"""Commands of `twin` (doctor, plan, look, study, tune, fit-surrogate) and their terminal output."""
