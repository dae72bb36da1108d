"""One operating-system process of a running graph."""
