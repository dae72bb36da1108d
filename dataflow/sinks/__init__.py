"""Processes that take whole streams: the recorder, the flight recorder, the viewer file."""
