"""Records and a recording give the same calls again, in one process."""
