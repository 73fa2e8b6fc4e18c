"""Monte Carlo studies and plan tuning: sampling of scenarios, execution on many workers, statistics and reports."""
