"""Assembly of one survey, its monitoring, and its evaluation and output."""
