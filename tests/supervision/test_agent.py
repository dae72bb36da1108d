"""What an agent passes on to the processes of its machine."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.machines.files import FilesError
from dataflow.machines.pipe import Clocks
from dataflow.supervision import agent
from dataflow.supervision.agent import Stay


def test_a_file_for_which_there_is_no_room_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "Pipe", lambda *_, **__: SimpleNamespace())
    (tmp_path / "models").write_text("a file where a folder would be")
    stay = Stay(SimpleNamespace(name="robot", folder=tmp_path), None, "run", "none")  # type: ignore[arg-type]
    piece = {"path": "models/net.bin", "at": 0, "data": b"x", "last": True, "digest": ""}
    with pytest.raises(FilesError, match=r"'models/net\.bin' cannot be written into /.*: File exists"):
        stay._take_piece(piece)


class Children:
    """Stands for the processes: keeps what was sent to each."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []

    def spawn(self, label: str) -> None:
        self.sent.append((label, "spawn"))

    def send(self, label: str, kind: str, fields: dict[str, Any], *, replaces: bool) -> None:
        self.sent.append((label, kind))


def test_a_process_is_told_of_the_clock_only_once_it_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks()
    clocks.exchanged(100, 1600, 1700, 1200)
    monkeypatch.setattr(agent, "Pipe", lambda *_, **__: SimpleNamespace(clocks=clocks))
    monkeypatch.setattr(agent, "CLOCK_EVERY", 0.0)
    stay, children = Stay(SimpleNamespace(name="robot"), None, "run", "none"), Children()  # type: ignore[arg-type]
    stay._children, stay._corrected = children, frozenset({"camera"})  # type: ignore[assignment]

    for _ in range(2):  # started, and started again
        stay._obey("camera", "spawn", {})
        stay._tell_clock()  # between two frames of the supervisor
        stay._obey("camera", "send", {"kind": "polled", "fields": {}, "replaces": False})
        stay._obey("camera", "send", {"kind": "go", "fields": {"at": 0.0}, "replaces": False})
        stay._tell_clock()

    started = ["spawn", "polled", "clock", "go", "clock"]
    assert children.sent == [("camera", kind) for kind in started * 2]
