"""Watchers: each follows the events of a run for one concern."""
