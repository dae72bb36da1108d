"""Whose input was written into is said by the operator that wrote, as far as it was given the message itself."""

from __future__ import annotations

import numpy as np
import pytest
from firing_operators import entry

from dataflow.execution.memory import MemoryGuard
from dataflow.sync import Firing


@pytest.mark.parametrize(
    ("readers", "writer", "whose"),
    [
        (("writer",), "writer", "its input 'of_writer'"),
        (("other", "writer"), "writer", "its input 'of_writer'"),
        (("writer", "other"), "writer", "its input 'of_writer'"),
        (("first", "second"), "writer", "the input 'of_first' of first"),
    ],
)
def test_a_message_that_several_were_given_is_the_input_of_the_writer(
    readers: tuple[str, ...], writer: str, whose: str
) -> None:
    guard, given = MemoryGuard(keeping=True), entry("x", 7, 0)
    for reader in readers:
        guard.take(reader, Firing(7, "fire", inputs={f"of_{reader}": given}))

    rows = np.asarray(given.value.vectors)
    rows.flags.writeable = True
    rows += 1

    assert guard.changed(writer) == f"{whose} (FeatureVector at stamp 7)"
    assert not guard.changed(writer)


@pytest.mark.parametrize("order", ["reader first", "writer first"])
def test_readers_of_an_overwritten_message_are_reached(order: str) -> None:
    guard, before, given = MemoryGuard(keeping=True), entry("x", 6, 0), entry("x", 7, 1)
    guard.take("bystander", Firing(6, "fire", inputs={"x": before}))
    if order == "reader first":
        guard.take("reader", Firing(9, "fire", inputs={"x": given}))
    guard.take("writer", Firing(7, "fire", inputs={"x": given}))
    rows = np.asarray(given.value.vectors)
    rows.flags.writeable = True
    rows += 1
    guard.changed("writer")
    if order == "writer first":
        guard.take("reader", Firing(9, "fire", inputs={"x": given}))

    assert guard.reached == {"reader": ("writer", 9)}
