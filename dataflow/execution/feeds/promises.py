"""Bounds what a recorded stream may promise, when the clock behind it went back in the recorded run.

Where a stream begins a new incarnation with earlier stamps, an aligner drops what lies at or before the stamp that the
stream had reached, as late. A promise must therefore hold against every later message that is not late, and against
every later message of the same incarnation.
"""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.sync import FOREVER, NEVER


def promises(stamps: Sequence[int]) -> list[int]:
    """Returns the largest frontier that may be promised when the first k messages have been given, for k = 0, 1, ...

    `stamps`: of all messages, in the order of the stream. `NEVER`: nothing beyond the message itself.
    """
    reached = [NEVER]
    for stamp in stamps:
        reached.append(max(reached[-1], stamp))
    found = [FOREVER]
    following = FOREVER
    """The first stamp to come that is not late, less 1."""
    for k in range(len(stamps) - 1, -1, -1):
        if stamps[k] > reached[k]:
            following = stamps[k] - 1
        caught_up = k == 0 or stamps[k - 1] == reached[k]
        found.append(following if caught_up else NEVER)
    return found[::-1]
