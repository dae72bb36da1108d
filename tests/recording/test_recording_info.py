"""describe tells what a recording holds; machine facts are complete and stable."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from made_recordings import pose

from dataflow.messages import Pose
from dataflow.recording import Recording, RecordingWriter, describe, machine_facts
from dataflow.recording.layout import FLIGHT
from dataflow.recording.streams.cutting import triggers_of


def test_a_description_counts_rates_sizes_firings_and_metadata(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={"graph": {"text": "line one\nline two"}}) as writer:
        writer.add_stream("robot/odometry", Pose, extra={"operator": "odometry"})
        writer.add_stream("robot/[mount]", Pose, static=True)
        writer.write("robot/[mount]", pose(1), seq=0)
        for seq in range(21):
            writer.write("robot/odometry", pose(10**18 + seq * 50_000_000), seq=seq)
        writer.write_firings("odometry", 10**18, b"1")
        writer.write_event("gap", 10**18, {})
    with Recording(path) as recording:
        found = describe(recording)
    mount, odometry = found.streams
    assert (odometry.count, odometry.rate, odometry.type) == (21, 20.0, "Pose")
    assert mount.static
    assert (found.start, found.duration) == (10**18, 10**9)  # static streams do not stretch it
    assert (found.messages, found.firings, found.events, found.torn) == (22, {"odometry": 1}, {"gap": 1}, False)
    assert found.bytes == path.stat().st_size
    assert json.loads(json.dumps(found.as_json()))["streams"][1]["name"] == "robot/odometry"


def test_a_torn_recording_is_described_as_torn(record: Callable[..., Path]) -> None:
    path = record([("a", pose(i)) for i in range(1, 9)], chunk_bytes=1)
    path.write_bytes(path.read_bytes()[:-400])
    with Recording(path) as recording:
        assert describe(recording).torn


def test_machine_facts_are_text_sorted_and_repeatable() -> None:
    facts = machine_facts()
    assert facts == machine_facts()
    assert facts["machine"]["python"].count(".") == 2
    assert int(facts["machine"]["cores"]) >= 1
    assert {"numpy", "mcap", "eclipse-zenoh"} <= facts["packages"].keys()
    for mapping in facts.values():
        assert list(mapping) == sorted(mapping)
        assert all(isinstance(value, str) for value in mapping.values())


@pytest.mark.parametrize(
    ("triggers", "said"),
    [
        ('[{"what": "c failed (a.py:4)", "stamp": 5}, {"what": "asked for"}]', ["c failed (a.py:4)", "asked for"]),
        ("[", []),
        ("{}", []),
        ('[1, {"stamp": 5}]', []),
    ],
)
def test_triggers_of_a_flight_recording_are_read(triggers: str, said: list[str]) -> None:
    assert triggers_of({FLIGHT: {"triggers": triggers}}) == said
