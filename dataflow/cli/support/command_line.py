"""The command line of this process."""

words: list[str] | None = None
"""Its arguments, where this process is the command and no other program that calls commands."""
