"""Goes to any recorded call of an operator: what it was given, what it made, its state before and after."""
