"""Imported by `looking`: its source and its bytecode are read."""

HELPED = 1
