"""Operators that repeat: two give equal outputs, and one that is restored from a snapshot goes on as the first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import Message, MessageError
from dataflow.operator import Operator


def made(operator: Any, call: Mapping[str, Any] | Sequence[Any]) -> dict[str, bytes]:
    """The digests of what an operator gives for one call of `process`, by port; empty for nothing."""
    found = operator.process(**call) if isinstance(call, Mapping) else operator.process(*call)
    ports = found if isinstance(found, Mapping) else {} if found is None else {"": found}
    return {port: _digest(message) for port, message in ports.items()}


def _digest(message: Message) -> bytes:
    try:
        return message.digest()
    except MessageError:  # its stamp and frame are those of the firing
        return message.replace(stamp=0, frame="").digest()


def assert_repeats(
    make: Callable[[], Operator], calls: Sequence[Mapping[str, Any] | Sequence[Any]], at: int
) -> list[dict[str, bytes]]:
    """Asserts that two operators give equal outputs, and so does one that begins with the snapshot before call `at`."""
    first, again, restored = (make() for _ in range(3))
    for each in (first, again, restored):
        each.setup()
    expected = []
    for k, call in enumerate(calls):
        if k == at:
            restored.restore(unpack_state(pack_state(first.snapshot() or {})))
        expected.append(made(first, call))
    assert [made(again, call) for call in calls] == expected
    assert [made(restored, call) for call in calls[at:]] == expected[at:]
    assert dict(restored.summary()) == dict(first.summary())
    return expected
