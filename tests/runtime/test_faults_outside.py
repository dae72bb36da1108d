"""Faults outside the operators: a full disk, a viewer that dies, a process that is stopped, slow subscribers."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import zenoh
from background_run import Background

from dataflow.client.attach import find_running
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.supervision.run import run
from dataflow.transport import Envelope, Kind, NetworkConfig, decode
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent

GRAPH = """\
graph: outside
namespace: test
network: {shared_memory: false}
operators:
  left: {use: "SOURCE", params: {count: COUNT}}
  smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}}
  sum: {use: runtime_operators:Sum, inputs: {x: left/fast}, live: {queue: oldest, size: 1000}}
"""


@pytest.fixture(autouse=True)
def _registry_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def graph_file(folder: Path, *, count: int, source: str = "runtime_operators:Counter") -> Path:
    path = folder / "outside.yaml"
    path.write_text(GRAPH.replace("COUNT", str(count)).replace("SOURCE", source))
    return path


# A disk that is full

RUN = ("run", "outside.yaml", "--live", "--record", "small/run.mcap", "--record-failure")


def check_full_disk(command: list[str], folder: Path, words: str, then: str = "end", **options: Any) -> str:
    """A recording that the disk does not take fails the run, which says so; returns what it prints."""
    done = subprocess.run(
        [*command, sys.executable, "-m", "dataflow.cli.main", *RUN, then],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent.parent)])},
        capture_output=True,
        text=True,
        timeout=60,
        **options,
    )

    assert done.returncode == 1, done.stderr
    assert words in done.stderr
    assert "run.mcap" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    return done.stdout


def check_what_is_left(path: Path) -> None:
    with Recording(path) as recording:
        numbers = [float(r.message.vectors[0, 0]) for r in recording.messages(["test/left/fast"])]
    assert numbers
    assert numbers == list(range(len(numbers)))


@pytest.mark.long
def test_a_recording_that_may_not_grow_ends_the_run_and_stays_readable(tmp_path: Path) -> None:
    graph_file(tmp_path, count=3000, source="faulty_operators:Noise")
    (tmp_path / "small").mkdir()

    check_full_disk(
        [],
        tmp_path,
        "File too large",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, 4_000_000)),
    )

    check_what_is_left(tmp_path / "small" / "run.mcap")


@pytest.mark.long
def test_run_continues_on_a_full_disk_and_reports_the_loss(tmp_path: Path) -> None:
    graph_file(tmp_path, count=600, source="faulty_operators:Noise")
    (tmp_path / "small").mkdir()

    told = check_full_disk(
        [],
        tmp_path,
        "recording stops, the run goes on",
        "go_on",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, 4_000_000)),
    )

    assert told.startswith("outside  complete")
    assert "not recorded, from" in told
    assert "File too large" in " ".join(told.split())  # a terminal's width breaks lines anywhere
    check_what_is_left(tmp_path / "small" / "run.mcap")


def _may_mount() -> bool:
    """Whether a small file system of one's own can be had."""
    if shutil.which("unshare") is None:
        return False
    tried = ["unshare", "-m", "sh", "-c", "mount -t tmpfs -o size=64k tmpfs /mnt"]
    return subprocess.run(tried, capture_output=True, timeout=10).returncode == 0


@pytest.mark.long
@pytest.mark.skipif(not _may_mount(), reason="needs the right to mount a file system (unshare -m, as root)")
def test_a_disk_that_is_full_ends_the_run_and_the_recording_stays_readable(tmp_path: Path) -> None:
    graph_file(tmp_path, count=3000, source="faulty_operators:Noise")
    (tmp_path / "small").mkdir()
    mount = 'mount -t tmpfs -o size=4000k tmpfs small; "$@"; code=$?; cp small/run.mcap kept.mcap; exit $code'

    check_full_disk(["unshare", "-m", "sh", "-c", mount, "sh"], tmp_path, "No space left on device")

    check_what_is_left(tmp_path / "kept.mcap")


# A viewer that dies


@pytest.mark.long
def test_a_viewer_that_is_killed_is_not_missed(tmp_path: Path) -> None:
    graph = load_graph(graph_file(tmp_path, count=250), live=True)
    running = Background(graph, live=True, record=tmp_path / "run.mcap", placement="process_each")
    find_running("outside", wait=30)
    viewer = subprocess.Popen(
        [sys.executable, "-m", "dataflow.cli.main", "echo", "--json"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent.parent)])},
        stdout=subprocess.PIPE,
    )
    try:
        assert viewer.stdout is not None
        assert viewer.stdout.readline().startswith(b"{")  # it is attached and served
    finally:
        viewer.send_signal(signal.SIGKILL)
        viewer.communicate(timeout=10)
    report = running.end()

    dropped = sum(count for drops in report.drops.values() for _, _, count in drops)  # a busy machine may be late
    assert report.summaries["sum"]["count"] + dropped == 250
    assert report.summaries["sum"]["count"] > 125
    assert not report.restarts
    assert verify(tmp_path / "run.mcap", jobs=1).identical


# A process that is stopped


STOPPED = """\
graph: outside
namespace: test
operators:
  left: {use: faulty_operators:Large, params: {count: COUNT}}
  stopped:
    use: faulty_operators:Stopped
    inputs: {x: left/fast}
    params: {at: 20, file: "FILE"}
    live: {queue: newest, size: 10}
  waker:
    use: faulty_operators:Waker
    inputs: {x: left/fast}
    params: {at: 320, file: "FILE"}
    live: {queue: newest, size: 1000}
"""


@pytest.mark.long
def test_stopped_consumer_delays_no_other_process_and_its_loss_is_counted(
    tmp_path: Path,
) -> None:
    """Messages of 1 MB: what it does not take is more than the memory that large messages lie in."""
    path = tmp_path / "outside.yaml"
    path.write_text(STOPPED.replace("COUNT", "360").replace("FILE", str(tmp_path / "pid")))

    report = run(load_graph(path, live=True), live=True, placement="process_each")

    assert report.summaries["waker"]["count"] == 360, report.drops
    assert "left" not in report.drops
    assert report.transport["left"]["shared_full"] == 0
    reasons = {why: n for _, why, n in report.drops["stopped"]}
    assert reasons["missed"] >= 50
    assert report.summaries["stopped"]["count"] + sum(reasons.values()) == 360
    assert not report.restarts


# Subscribers from outside


class Outside:
    """A plain Zenoh program that subscribes to all streams of a running graph. `slow`: it takes nothing any more."""

    def __init__(self, *, slow: bool) -> None:
        self.seen: dict[str, list[Envelope]] = {}
        self._end = threading.Event()
        found = find_running("outside", wait=30)
        self._session = zenoh.open(NetworkConfig(connect=found.endpoints).zenoh_config())
        take = self._wait if slow else self._take
        self._session.declare_subscriber("test/**", zenoh.handlers.Callback(take, indirect=False))

    def _wait(self, sample: zenoh.Sample) -> None:
        self._end.wait()

    def _take(self, sample: zenoh.Sample) -> None:
        self.seen.setdefault(str(sample.key_expr), []).append(decode(bytes(sample.payload)))

    def close(self) -> None:
        self._end.set()
        self._session.close()


@pytest.mark.long
@pytest.mark.parametrize("live", [False, True])
def test_a_plain_subscriber_gets_every_message_in_the_documented_envelope(tmp_path: Path, live: bool) -> None:
    graph = load_graph(graph_file(tmp_path, count=150), live=live)
    running = Background(graph, live=live, rate=1.0, record=tmp_path / "run.mcap", placement="process_each")
    outside = Outside(slow=False)
    try:
        running.end()
    finally:
        outside.close()
    with Recording(tmp_path / "run.mcap") as recording:
        for stream in ("test/left/fast", "test/smooth/mean"):
            stored = {r.message.stamp: r.message.digest() for r in recording.messages([stream])}
            seen = outside.seen[stream]
            messages = [envelope.message for envelope in seen if envelope.message is not None]
            numbers = [envelope.seq for envelope in seen if envelope.message is not None]
            assert numbers == list(range(numbers[0], len(stored)))  # all, from when it subscribed
            assert [m.digest() for m in messages] == [stored[m.stamp] for m in messages]
            assert seen[-1].kind is Kind.END


@pytest.mark.long
def test_slow_outside_subscriber_does_not_delay_the_run(tmp_path: Path) -> None:
    """Messages of 1 MB: it blocks what publishes to it at once."""
    path = tmp_path / "outside.yaml"
    path.write_text(STOPPED.replace("COUNT", "250").replace("at: 20", "at: -1").replace("FILE", str(tmp_path / "pid")))
    running = Background(load_graph(path, live=True), live=True, placement="process_each")
    outside = Outside(slow=True)
    try:
        report = running.end()
    finally:
        outside.close()
    assert report.summaries["waker"]["count"] == 250
    assert "left" not in report.drops
    assert report.summaries["stopped"]["count"] + sum(n for *_, n in report.drops.get("stopped", ())) == 250


@pytest.mark.long
def test_nothing_is_published_without_subscribers(tmp_path: Path) -> None:
    report = run(load_graph(graph_file(tmp_path, count=20)), placement="process_each")

    assert {label: counts["published_messages"] for label, counts in report.transport.items()} == dict.fromkeys(
        ("left", "smooth", "sum"), 0
    )
    assert report.transport["smooth"]["received_messages"] >= 20
