"""Captures a recorded call in which something is wrong as a test with the smallest inputs that still show it."""
