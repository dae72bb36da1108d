"""Finds by making calls again with other inputs which of them decided a value of a recorded message."""
