"""The grid on which the focus network answers."""

STRIDE = 2
"""Pixels along a side of a cell."""
MULTIPLE = 16
"""Pixels of which a region's height and width are multiples."""
