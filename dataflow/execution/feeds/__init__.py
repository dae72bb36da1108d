"""Feeds put messages into a graph: windows, sources, recordings."""
