"""Streams of a process: what arrives, what leaves, in which order, and what was lost."""
