"""Training of the networks: data, loop, checkpoints, export and the commands."""
