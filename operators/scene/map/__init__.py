"""The map of objects and surfaces: what was seen where, joined over time."""
