"""Sensors of the filter: their settings, and measurements of the body made of their messages."""
