"""A second detector that looks at parts of an image in its own resolution, where a first one saw small things."""
