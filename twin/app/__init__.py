"""Implementation of commands of `twin`: terminal output, machine check, survey plan, camera view, studies, fit."""
