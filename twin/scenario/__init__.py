"""The scenario: its models and its TOML file."""
