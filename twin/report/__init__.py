"""Presentation of results: run folder, HTML report, figures, 3-D recording."""
