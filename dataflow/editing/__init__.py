"""Cuts, filters, merges, splits and recovers recordings, so that what is left replays and verifies where it can."""
