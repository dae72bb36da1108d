"""A running graph computes the same whatever somebody who may connect to it publishes on its streams."""

from __future__ import annotations

from pathlib import Path

import pytest
import zenoh
from background_run import Background
from runtime_operators import value
from tests_runtime_graphs import chain

from dataflow.client.attach import find_running
from dataflow.supervision.run import run
from dataflow.transport import Envelope, Kind, NetworkConfig, encode
from dataflow.verification.verify import verify

KEYS = ("test/left/fast", "test/smooth/mean")


@pytest.fixture(autouse=True)
def _registry_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def forged(key: str) -> list[bytes]:
    late = value(2**61, 666.0)
    return [
        encode(Envelope(Kind.END, key, 0, 0, 2**62, None, "forged")),
        encode(Envelope(Kind.FRONTIER, key, 0, 0, 2**62)),
        encode(Envelope(Kind.FRONTIER, key, 0, 0, 2**63 - 1)),
        encode(Envelope(Kind.MESSAGE, key, 0, 10**6, late.stamp, late)),
        encode(Envelope(Kind.MESSAGE, key, 99, 0, late.stamp, late)),
        b"\xc1garbage",
    ]


@pytest.mark.long
@pytest.mark.parametrize("live", [False, True], ids=["run", "live"])
def test_forged_ends_frontiers_and_messages_change_nothing(tmp_path: Path, live: bool) -> None:
    graph = chain(
        "smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}, params: {sleep: 0.01}}",
        "sum: {use: runtime_operators:Sum, inputs: {x: smooth/mean}}",
        count=100,
    )
    undisturbed = run(graph, placement="one_process")
    path = tmp_path / "run.mcap"
    running = Background(graph, record=path, live=live)
    found = find_running("chain", wait=30)
    forger = zenoh.open(NetworkConfig(connect=found.endpoints).zenoh_config())
    try:
        for key in KEYS:
            publisher = forger.declare_publisher(key)
            assert not publisher.matching_status.matching  # no process of the run subscribes to a stream's key
            for payload in forged(key):
                publisher.put(payload)
    finally:
        forger.close()
        report = running.end()
    assert report.summaries == undisturbed.summaries
    assert report.streams == undisturbed.streams or live
    assert verify(path, jobs=1).identical
