"""Plug-ins: controllers, estimators, terrains and readers of other packages that replace those of this package."""
