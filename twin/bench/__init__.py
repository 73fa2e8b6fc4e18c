"""Benchmark: the cost of each stage of a survey as a ratio to that of the best library call or limit, its floor."""
