"""Assembly, monitoring, evaluation and output of one survey."""
