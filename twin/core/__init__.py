"""Types, geometry and settings shared by all packages."""
