"""Furniture and small things, and how they are put into rooms."""
