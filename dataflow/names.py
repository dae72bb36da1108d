"""The runtime's own keys. They lie in verbatim chunks, which no wildcard matches."""

from __future__ import annotations


def firings_key(namespace: str, operator: str) -> str:
    """Returns where an operator's firing records travel and are recorded."""
    return f"{namespace}/@/firings/{operator}"


def logs_key(namespace: str) -> str:
    """Names the stream as which a viewer shows the log."""
    return f"{namespace}/@/logs"


def diagnostics_key(namespace: str) -> str:
    """The stream of `Diagnostics` about the run itself, in its recording."""
    return f"{namespace}/@/diagnostics"
