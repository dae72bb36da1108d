"""Analyses the firing records of a run: latencies from sources to sinks."""
