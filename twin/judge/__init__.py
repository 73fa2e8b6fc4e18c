"""Evaluation of the estimates against the truth. Computes metrics only; `twin.report` presents them."""
