"""What the firing records of a run say about it: latencies from sources to sinks."""
