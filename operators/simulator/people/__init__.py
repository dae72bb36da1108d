"""People and other movers: bodies, scripts, choices, and how they are brought into a world."""
