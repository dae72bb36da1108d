"""Words for what messages say about processes and time."""

from __future__ import annotations

import signal


def how_it_ended(code: int | None) -> str:
    """Returns the meaning of a process's exit code."""
    if code is None:
        return "ended in a way that is not known"
    if code >= 0:
        return f"exited with code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"


def how_long(seconds: float) -> str:
    """Returns a span in words, however long it is."""
    for unit, length in (("years", 365.25 * 86400), ("days", 86400.0), ("hours", 3600.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.0f} s"
