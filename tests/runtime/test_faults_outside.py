"""Faults outside the operators: a full disk, a viewer that dies, a link between two processes that breaks."""

from __future__ import annotations

import os
import resource
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from background_run import Background

from dataflow.client.attach import find_running
from dataflow.graph import Graph, load_graph
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.report import RunReport
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent

GRAPH = """\
graph: outside
namespace: test
network: {shared_memory: false}
operators:
  left: {use: "SOURCE", params: {count: COUNT}}
  smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}}
  sum: {use: runtime_operators:Sum, inputs: {x: left/fast}}
"""


@pytest.fixture(autouse=True)
def _registry_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def graph_file(folder: Path, *, count: int, source: str = "runtime_operators:Counter") -> Path:
    path = folder / "outside.yaml"
    path.write_text(GRAPH.replace("COUNT", str(count)).replace("SOURCE", source))
    return path


# A disk that is full

RUN = ("run", "outside.yaml", "--live", "--record", "small/run.mcap")


def check_full_disk(command: list[str], folder: Path, words: str, **options: Any) -> None:
    """A recording that the disk does not take ends the run, says so, and holds what came before."""
    done = subprocess.run(
        [*command, sys.executable, "-m", "dataflow.cli.main", *RUN],
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


def check_what_is_left(path: Path) -> None:
    with Recording(path) as recording:
        numbers = [float(r.message.vectors[0, 0]) for r in recording.messages(["test/left/fast"])]
    assert numbers
    assert numbers == list(range(len(numbers)))


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


def _may_mount() -> bool:
    """Whether a small file system of one's own can be had."""
    if shutil.which("unshare") is None:
        return False
    tried = ["unshare", "-m", "sh", "-c", "mount -t tmpfs -o size=64k tmpfs /mnt"]
    return subprocess.run(tried, capture_output=True, timeout=10).returncode == 0


@pytest.mark.skipif(not _may_mount(), reason="needs the right to mount a file system (unshare -m, as root)")
def test_a_disk_that_is_full_ends_the_run_and_the_recording_stays_readable(tmp_path: Path) -> None:
    graph_file(tmp_path, count=3000, source="faulty_operators:Noise")
    (tmp_path / "small").mkdir()
    mount = 'mount -t tmpfs -o size=4000k tmpfs small; "$@"; code=$?; cp small/run.mcap kept.mcap; exit $code'

    check_full_disk(["unshare", "-m", "sh", "-c", mount, "sh"], tmp_path, "No space left on device")

    check_what_is_left(tmp_path / "kept.mcap")


# A viewer that dies


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

    assert report.summaries["sum"]["count"] == 250
    assert not report.restarts
    assert verify(tmp_path / "run.mcap", jobs=1).identical


# A link that is lost


class Link:
    """A wire between two processes, for a test to cut: a proxy in front of `endpoint`, a Unix socket."""

    def __init__(self, endpoint: str) -> None:
        self._to = endpoint.removeprefix("unixsock-stream/")
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(f"{self._to}.wire")
        self._server.listen()
        self.endpoint = f"{endpoint}.wire"
        self.whole = True
        self.carried = 0
        self.cuts = 0
        self._over = False
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        while not self._over:
            able, _, _ = select.select([self._server, *self._pairs], [], [], 0.02)
            if not self.whole:
                self._drop()
            for end in able:
                if end is self._server:
                    self._accept()
                elif end in self._pairs:
                    self._pass(end)

    def _accept(self) -> None:
        near, _ = self._server.accept()
        try:
            if not self.whole:
                raise ConnectionError("the wire is cut")
            far = socket.socket(socket.AF_UNIX)
            far.connect(self._to)
        except OSError:  # nobody is there (any more)
            near.close()
        else:
            self._pairs |= {near: far, far: near}

    def _pass(self, end: socket.socket) -> None:
        try:
            data = end.recv(1 << 16)
            if data:
                self._pairs[end].sendall(data)
                self.carried += len(data)
                return
        except OSError:
            pass  # either end is gone: so is the connection
        self._close(end)

    def _close(self, end: socket.socket) -> None:
        for each in (end, self._pairs.pop(end)):
            self._pairs.pop(each, None)
            each.close()

    def _drop(self) -> None:
        while self._pairs:
            self.cuts += 1
            self._close(next(iter(self._pairs)))

    def end(self) -> None:
        self._over = True
        self._thread.join(5)
        self.whole = False
        self._drop()
        self._server.close()


@pytest.fixture
def links() -> Iterator[list[Link]]:
    made: list[Link] = []
    yield made
    for link in made:
        link.end()


def run_with_a_cut(label: str, graph: Graph, path: Path, links: list[Link]) -> RunReport:
    """A live run, a process each, in which every link to the process `label` is cut for half a second."""
    supervisor = Supervisor(RunPlan(graph, live=True, placement="process_each", record=path))
    _, config = supervisor.core.run.configs[label]
    links.extend(Link(endpoint) for endpoint in config["connect"])
    config["connect"] = [link.endpoint for link in links]
    reports: list[RunReport] = []
    thread = threading.Thread(target=lambda: reports.append(supervisor.run()))
    thread.start()
    try:
        find_running("outside", wait=30)
        time.sleep(0.5)
        for link in links:
            link.whole = False
        time.sleep(0.5)
        for link in links:
            link.whole = True
    finally:
        thread.join(60)
    assert sum(link.cuts for link in links) >= 1
    (report,) = reports
    return report


def gaps_in(path: Path) -> list[Mapping[str, Any]]:
    with Recording(path) as recording:
        return [event.data for event in recording.events() if event.name == "gap"]


def test_a_link_that_is_lost_and_restored_loses_messages_but_neither_the_run_nor_the_proof(
    tmp_path: Path, links: list[Link]
) -> None:
    """The link from `left` to `smooth`; everything else stays connected."""
    graph, path = load_graph(graph_file(tmp_path, count=300), live=True), tmp_path / "run.mcap"

    report = run_with_a_cut("smooth", graph, path, links)

    assert report.summaries["sum"]["count"] == 300  # whose link was whole
    gaps = gaps_in(path)
    assert [(gap["stream"], gap["taker"]) for gap in gaps] == [("test/left/fast", "smooth")]
    (gap,) = gaps
    assert 0 < gap["following"] - gap["first"] < 299  # it came back
    verified = verify(path, graph=graph, jobs=1)
    assert verified.identical, verified.as_json()


def test_a_recorder_that_was_cut_off_has_every_firing_record_and_its_gaps_are_said(
    tmp_path: Path, links: list[Link]
) -> None:
    graph, path = load_graph(graph_file(tmp_path, count=300), live=True), tmp_path / "run.mcap"

    run_with_a_cut("@recorder", graph, path, links)

    assert {gap["taker"] for gap in gaps_in(path)} == {"@recorder"}
    with Recording(path) as recording:
        for operator in graph.nodes:
            indices = sorted(record.index for record in recorded_firings(recording, operator))
            assert indices == list(range(len(indices))), operator
    verified = verify(path, graph=graph, jobs=1)
    assert not verified.identical
    assert not any(v.lost_records or v.unaccounted or v.unfinished for v in verified.operators)
    assert all(v.verdict == "unverifiable" and v.unverifiable for v in verified.operators)
