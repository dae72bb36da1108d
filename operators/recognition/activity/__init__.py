"""Activities of agents: features, recognition, and training of the network."""
