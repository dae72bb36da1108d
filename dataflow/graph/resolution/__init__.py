"""From the flat list of operators to the graph: wired, checked, settled."""
