"""Objects of an image in space."""
