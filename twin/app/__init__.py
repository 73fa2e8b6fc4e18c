"""Commands of `twin` (doctor, plan, look, study, tune, fit-surrogate, export) and their terminal output."""
