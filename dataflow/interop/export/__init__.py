"""Writes recordings and bags in the formats of other systems."""
