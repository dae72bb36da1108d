"""A gate passes on what a machine makes, and nothing else that it sends."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import pytest

from dataflow.machines.gate import Gate, Routes, Word
from dataflow.process.streams.inbox import Inbox
from dataflow.transport import Fanout

KEYS = ["test/arm/pose", "test/robot/image"]


@pytest.fixture
def passed() -> dict[str, list[bytes]]:
    return {"arm": [], "robot": []}


@pytest.fixture
def gate(passed: dict[str, list[bytes]]) -> Gate:
    """The gate of the supervisor between two machines, each of which takes what the other makes."""
    makers = {KEYS[0]: ["arm"], KEYS[1]: ["robot"]}
    takers = {KEYS[0]: ["robot"], KEYS[1]: ["arm"]}
    pipes = {
        name: SimpleNamespace(send=lambda frame, droppable=False, name=name: passed[name].append(frame))
        for name in passed
    }
    routes = Routes(KEYS, makers, takers, frozenset(), frozenset(KEYS))
    said: list[Word] = []

    def say(machine: str, word: Word) -> None:
        said.append(word)
        assert word[2]["fields"]

    return Gate(Inbox(), Fanout([]), pipes, routes, say)


def test_a_machine_sends_nothing_in_the_place_of_another(gate: Gate, passed: dict[str, list[bytes]]) -> None:
    image = struct.pack("!H", 1) + b"image"

    gate.handle(("frame", "robot", image))
    assert passed == {"arm": [image], "robot": []}
    gate.handle(("frame", "arm", image))

    assert passed == {"arm": [image], "robot": []}
    assert gate.malformed == 1


@pytest.mark.parametrize("frame", [b"", b"\0", b"\0\7image", b"\xff\xff\xc1", b"\xff\xff\x93\xa0\xa1x\x80"])
def test_a_frame_that_is_none_is_counted(gate: Gate, passed: dict[str, list[bytes]], frame: bytes) -> None:
    gate.handle(("frame", "robot", frame))

    assert gate.malformed == 1
    assert not passed["arm"]
