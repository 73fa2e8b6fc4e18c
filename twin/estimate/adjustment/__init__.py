"""Least-squares adjustment of pose graphs."""
