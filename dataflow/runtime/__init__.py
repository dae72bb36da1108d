"""Running graphs: hosts as processes, their supervisor, firing records, replay."""
