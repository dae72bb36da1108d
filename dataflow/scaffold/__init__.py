"""Beginnings of operators, graphs and projects, as files whose tests pass."""
