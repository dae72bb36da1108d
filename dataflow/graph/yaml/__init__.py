"""Graph files as trees of values that know their line and column: read, checked, bounded."""
