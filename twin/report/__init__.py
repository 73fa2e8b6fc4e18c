"""Everything that draws or words results."""
