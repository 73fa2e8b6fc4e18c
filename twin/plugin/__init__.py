"""Plug-ins: controllers, estimators, terrains and readers that other packages provide."""
