"""Faults on purpose, planned by a seed."""
