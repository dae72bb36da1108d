"""What puts messages into a graph: windows, sources, recordings."""
