"""Firing records: what each call of an operator was given and what it gave."""
