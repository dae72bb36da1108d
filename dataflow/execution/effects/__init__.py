"""Effects: calls of an operator that cannot repeat, with their recorded answers."""
