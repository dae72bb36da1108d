"""Postures of people: silhouettes, recognition, and training of the network."""
