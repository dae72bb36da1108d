"""Kinds of faults, by what they are done to."""

from __future__ import annotations

SECOND = 1_000_000_000
TO_OPERATORS = ("raise", "hang", "slow", "leak")
TO_SOURCES = ("stop", "flood", "jump", "past")
TO_PROCESSES = ("kill", "freeze")
