"""The scenario: its data model, and reading and writing of its TOML file."""
