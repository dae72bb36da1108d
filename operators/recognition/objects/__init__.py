"""Detection of known and of newly learned objects."""
