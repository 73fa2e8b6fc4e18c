"""Data model of a scenario, and reading, validation and writing of scenario files (TOML)."""
