"""Compares a re-execution with what was recorded."""
