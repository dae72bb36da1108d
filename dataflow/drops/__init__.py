"""Finds which of the messages that a live run lost, or had too late, cost its result: by replays in which they came."""
