"""The pure core of the supervisor: events in, commands out."""
