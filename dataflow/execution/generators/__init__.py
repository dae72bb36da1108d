"""Random generators, seeded before every call of an operator."""
