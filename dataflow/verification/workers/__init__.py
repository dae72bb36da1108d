"""The worker processes of a verification, and how operators are divided among them."""
