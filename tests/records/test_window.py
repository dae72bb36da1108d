"""The end of a recording is repeated from the records of the end, where it is known that nothing else is needed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from dataflow.messages import FeatureVector
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.layout import PARAMETERS, TOLD
from dataflow.records import window
from dataflow.records.firing import Emission, FiringRecord, encode_batch
from dataflow.records.reading import FiringLog, whole
from dataflow.records.window import records_from
from dataflow.sync import MessageRef

SECOND = 10**9
EPOCH = 1000 * SECOND


@dataclass
class Node:
    """A node of a graph, as far as its records need it."""

    name: str
    outputs: Mapping[str, str] = field(default_factory=dict)


MAKERS = [Node("cam", {"x": "g/cam/x"}), Node("op")]


def write(
    path: Path, *, told: bool = True, changed_at: int | None = None, looks_back: int = 0, set_up: int = 0
) -> None:
    """A source of 1 Hz and an operator that takes its messages, with a state every 10 s; a batch for every record.

    `set_up`: the log times of the batches with `setup()`, in s: the newest event time when they were written."""
    metadata = {TOLD: {"events": PARAMETERS}} if told else {}
    with RecordingWriter(path, metadata=metadata, overwrite=True) as writer:
        writer.add_stream("g/cam/x", FeatureVector)
        for name in ("cam", "op"):
            writer.write_firings(name, EPOCH + set_up * SECOND, encode_batch([FiringRecord(name, 0, 0, "setup", 0)]))
        index = 1
        for k in range(120):
            stamp = EPOCH + k * SECOND
            writer.write("g/cam/x", FeatureVector(stamp=stamp, vectors=np.zeros((1, 1), np.float32), model=""), seq=k)
            made = FiringRecord("cam", 0, k + 1, "fire", stamp, outputs=(Emission(k, stamp, bytes(16)),))
            taken = {"x": MessageRef("g/cam/x", 0, max(0, k - looks_back))}
            records: Sequence[FiringRecord] = [FiringRecord("op", 0, index, "fire", stamp, inputs=taken)]
            if k % 10 == 5:
                records = [*records, FiringRecord("op", 0, index + 1, "snapshot", stamp, detail={"state": b"s"})]
            index += len(records)
            writer.write_firings("cam", stamp, encode_batch([made]))
            writer.write_firings("op", stamp, encode_batch(list(records)))
            if k == changed_at:
                writer.write_event(PARAMETERS, stamp, {"operator": "op", "name": "gain"})


@contextmanager
def log_of(path: Path, *, stateful: Sequence[str] = ("op",)) -> Iterator[FiringLog]:
    with Recording(path) as recording:
        yield records_from(recording, MAKERS, EPOCH + 100 * SECOND, stateless=(), stateful=stateful)


@pytest.fixture(autouse=True)
def _near(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "FIRST_REACH", 8 * SECOND)


def test_records_before_the_window_are_not_read_and_a_cut_stands_for_them(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path)
    with log_of(path) as log:
        kept, lost = whole(log.of("op"))
    assert [r.kind for r in kept[:3]] == ["setup", "cut", "fire"]
    assert not lost
    assert kept[2].stamp == EPOCH + 92 * SECOND
    assert kept[1].detail["left_out"] == log.begins["op"] - 1
    assert any(r.kind == "snapshot" and r.stamp <= EPOCH + 100 * SECOND for r in kept)


@pytest.mark.parametrize(
    ("options", "first"),
    [
        ({"looks_back": 3}, 92),  # in the window still
        ({"looks_back": 20}, 68),  # the next window is four times as long
        ({"set_up": 95}, 92),  # `setup()` was written late, behind the beginning of the window
        ({"changed_at": 50}, None),  # not known what it was set to: all is read
        ({"changed_at": 119}, None),
        ({"told": False}, None),  # an older recording
    ],
)
def test_window_covers_the_needed_records_or_all_are_read(
    options: dict[str, int], first: int | None, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    write(path, **options)
    with log_of(path) as log:
        kept, lost = whole(log.of("op"))
        assert not lost
        if first is None:
            assert not log.begins
            assert len(log.of("op")) == 133
        else:
            assert kept[2].stamp == EPOCH + first * SECOND
