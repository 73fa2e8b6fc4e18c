"""The types that every room shares."""
