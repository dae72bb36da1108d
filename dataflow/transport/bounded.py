"""A bound on what a library may take: Zenoh's calls that end something wait for its threads."""

from __future__ import annotations

import threading
from collections.abc import Callable


def within(seconds: float, act: Callable[[], object], name: str) -> bool:
    """Runs `act` on a thread called `name`, and returns whether it came to its end in so many seconds. Raises what
    `act` raises. One that takes longer goes on, on its daemon thread, and its result is discarded."""
    failures: list[BaseException] = []

    def run() -> None:
        try:
            act()
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    thread.join(seconds)
    if failures:
        raise failures[0]
    return not thread.is_alive()
