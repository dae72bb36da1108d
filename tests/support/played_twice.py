"""What holds for every operator that counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dataflow.testing import play


def counted_twice(make: Callable[[], Any], streams: Mapping[str, Any], static: Sequence[str] = ()) -> dict[str, Any]:
    """Two plays are equal, and a restored operator sums up as the first, whose summary is returned."""
    first, second, restored = make(), make(), make()
    assert play(first, streams, static=static).digests() == play(second, streams, static=static).digests()
    restored.setup()
    restored.restore(first.snapshot())
    assert restored.summary() == first.summary()
    return dict(first.summary())
