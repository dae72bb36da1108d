"""What an agent passes on to the processes of its machine."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.machines import files
from dataflow.machines.pipe import Clocks
from dataflow.records.black_box import OperatorProgress, RecoveredRecords
from dataflow.supervision import agent
from dataflow.supervision.agent import RunParticipation
from dataflow.supervision.core import events


def test_a_file_for_which_there_is_no_room_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "Pipe", lambda *_, **__: SimpleNamespace())
    (tmp_path / "models").write_text("a file where a folder would be")
    stay = RunParticipation(SimpleNamespace(name="robot", folder=tmp_path), None, "run", "none")
    piece = {"path": "models/net.bin", "at": 0, "data": b"x", "last": True, "digest": ""}
    with pytest.raises(files.FilesError, match=r"'models/net\.bin' cannot be written into /.*: File exists"):
        stay._take_piece(piece)


class Children:
    """Stands for the processes: keeps what was sent to each."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []

    def spawn(self, label: str) -> None:
        self.sent.append((label, "spawn"))

    def send(self, label: str, kind: str, fields: dict[str, Any], *, replaces: bool) -> None:
        self.sent.append((label, kind))


def test_clock_offset_is_sent_only_to_running_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks()
    clocks.exchanged(100, 1600, 1700, 1200)
    monkeypatch.setattr(agent, "Pipe", lambda *_, **__: SimpleNamespace(clocks=clocks))
    monkeypatch.setattr(agent, "CLOCK_EVERY", 0.0)
    stay, children = RunParticipation(SimpleNamespace(name="robot"), None, "run", "none"), Children()
    stay._children, stay._corrected = children, frozenset({"camera"})

    for _ in range(2):  # started, and started again
        stay._obey("camera", "spawn", {})
        stay._tell_clock()  # between two frames of the supervisor
        stay._obey("camera", "send", {"kind": "polled", "fields": {}, "replaces": False})
        stay._obey("camera", "send", {"kind": "go", "fields": {"at": 0.0}, "replaces": False})
        stay._tell_clock()

    started = ["spawn", "polled", "clock", "go", "clock"]
    assert children.sent == [("camera", kind) for kind in started * 2]


@pytest.fixture
def stay(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tuple[RunParticipation, list[tuple[Any, ...]]]]:
    """A stay on a machine, and what it says: the label, the word, and its fields."""
    said: list[tuple[Any, ...]] = []
    monkeypatch.setattr(agent, "Pipe", lambda *_, **__: SimpleNamespace(clocks=Clocks()))
    monkeypatch.setattr(
        RunParticipation, "_say", lambda _, label, word, /, **fields: said.append((label, word, fields))
    )
    made = RunParticipation(SimpleNamespace(name="robot", folder=tmp_path), None, "run", "tcp/router")
    yield made, said
    for descriptor in (made._woken, made._waking, made._wake):
        os.close(descriptor)


def piece(data: bytes, at: int, *, last: bool, whole: bytes, path: str = "maps/hall.yaml") -> dict[str, Any]:
    return {"path": path, "at": at, "data": data, "last": last, "digest": hashed(whole)}


def hashed(data: bytes) -> str:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        return files.digest_of(Path(file.name))


def test_a_file_that_comes_in_pieces_is_in_its_place_when_it_is_whole_and_right(
    stay: tuple[RunParticipation, list[Any]], tmp_path: Path
) -> None:
    there, said = stay
    there._obey("", "file", piece(b"wide: ", 0, last=False, whole=b"wide: 3\n"))
    assert not (tmp_path / "maps/hall.yaml").exists()
    there._obey("", "file", piece(b"3\n", 6, last=True, whole=b"wide: 3\n"))
    assert (tmp_path / "maps/hall.yaml").read_bytes() == b"wide: 3\n"
    assert [word for _, word, _ in said] == ["took", "took"]

    there._obey("", "file", piece(b"anew", 0, last=True, whole=b"anew"))  # not after what was there before
    assert (tmp_path / "maps/hall.yaml").read_bytes() == b"anew"


def test_a_file_that_differs_is_outside_or_is_too_large_is_refused(
    stay: tuple[RunParticipation, list[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there, _ = stay
    with pytest.raises(files.FilesError, match=r"file 'maps/hall\.yaml' changed while it was sent"):
        there._obey("", "file", piece(b"wide", 0, last=True, whole=b"other"))
    assert not list((tmp_path / "maps").iterdir())
    with pytest.raises(files.FilesError):
        there._obey("", "file", piece(b"x", 0, last=True, whole=b"x", path="../outside"))
    assert not (tmp_path.parent / "outside").exists()
    monkeypatch.setattr(files, "MOST_SENT", 5)
    there._obey("", "file", piece(b"12345", 0, last=False, whole=b"x"))
    with pytest.raises(files.FilesError, match="has more than"):
        there._obey("", "file", piece(b"6", 5, last=True, whole=b"x"))


def test_machine_reports_missing_files_and_differences(
    stay: tuple[RunParticipation, list[Any]], tmp_path: Path
) -> None:
    there, said = stay
    (tmp_path / "same.yaml").write_bytes(b"same")
    digests = {"same.yaml": hashed(b"same"), "new": hashed(b"new")}
    none: dict[str, Any] = {"code": {}, "uses": [], "processes": [], "graph": {"nodes": []}}
    wanted = {"python": files.python(), "files": digests, **none}
    there._obey("", "prepare", wanted)
    there._obey("", "prepare", wanted | {"python": "CPython 2.7"})
    assert said[0] == ("", "lacks", {"files": ["new"]})
    assert said[1] == ("", "differs", {"what": [f"{files.python()} here, CPython 2.7 there"]})


@pytest.mark.parametrize(
    ("event", "word"),
    [
        (events.Received("sum", "progress", {"a": 1}), ("sum", "said", {"kind": "progress", "fields": {"a": 1}})),
        (events.Disconnected("sum"), ("sum", "hung up", {})),
        (
            events.NotReading("sum", 2.5, 9, True),
            ("sum", "not reading", {"seconds": 2.5, "waiting": 9, "overflowed": True}),
        ),
        (events.Exited("sum", -9), ("sum", "died", {"code": -9})),
        (
            events.OrphansKilled(("sum", "left"), ("cat (process 3)",)),
            ("", "left", {"labels": ["sum", "left"], "processes": ["cat (process 3)"]}),
        ),
        (events.Aborted("no memory"), ("", "failed", {"why": "no memory"})),
        (
            events.RecordsRecovered(
                "sum", RecoveredRecords({"sum": [b"x"]}, {"sum": OperatorProgress(2, {"mean": 5})})
            ),
            (
                "sum",
                "remained",
                {"batches": {"sum": [b"x"]}, "reached": {"sum": [*astuple(OperatorProgress(2, {"mean": 5}))]}},
            ),
        ),
    ],
    ids=["said", "hung up", "not reading", "died", "left behind", "aborted", "remained"],
)
def test_news_of_processes_go_to_the_supervisor(
    event: events.Event, word: tuple[Any, ...], stay: tuple[RunParticipation, list[Any]]
) -> None:
    there, said = stay
    there._feed(event)
    assert said == [word]


def test_a_process_is_configured_for_this_machine_and_goes_by_its_clock(
    stay: tuple[RunParticipation, list[Any]],
) -> None:
    """The clock here is 1.5 s behind the supervisor's."""
    there, _ = stay
    given: list[tuple[str, dict[str, Any]]] = []
    children = SimpleNamespace(send=lambda label, kind, fields, replaces: given.append((kind, fields)))
    there._children, there._endpoints = children, {"sum": "tcp/here"}
    network = {"listen": ["a"], "connect": ["b"], "tls": {"ca": "x"}, "access_control": {"c": "d"}}
    fields = {"listen": ["tcp/there"], "graph": {"network": network}}
    there._obey("sum", "send", {"kind": "operators", "fields": fields, "replaces": False})
    assert given.pop() == (
        "operators",
        {
            "listen": ["tcp/here"],
            "graph": {"network": {"listen": [], "connect": ["tcp/router"], "tls": {}, "access_control": {}}},
        },
    )
    there._pipe.clocks.exchanged(0, 1_500_000_050, 1_500_000_050, 100)
    there._obey("sum", "send", {"kind": "go", "fields": {"at": 10.0}, "replaces": False})
    assert given[-1] == ("go", {"at": pytest.approx(8.5, abs=1e-6)})
    there._obey("", "over", {})
    assert there._over
