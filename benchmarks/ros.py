"""Measures topics of ROS 2 in and out of a live, recorded graph, through a Zenoh router on loopback.

Run `python benchmarks/ros.py`; the last table is in `benchmarks/ros.md`. The other side of the topics is a process that
speaks the same wire; no ROS is involved.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh

import dataflow.ros as topics
from dataflow.graph import load_text
from dataflow.messages import Image, Message, Text, Transforms
from dataflow.ros.definitions import reader_for, type_hash, written
from dataflow.ros.losses import Losses
from dataflow.ros.node import Ros2Node
from dataflow.ros.sink import Ros2Sink
from dataflow.ros.wire import Attachment, Qos
from dataflow.supervision.core.report import RunReport
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.verify import verify

LOADS = {
    "1,000 Hz of 1 kB": ("Text", "std_msgs/msg/String", 1000.0),
    "30 Hz of 0.92 MB": ("Image", "sensor_msgs/msg/Image", 30.0),
}
GRAPH = """
graph: bench
operators:
  taken: {use: "dataflow.ros:%s", params: {topic: /out, type: %s, router: "%s"}, process: one}
  passed: {use: "ros_operators:Passed", inputs: {given: taken/message}, live: {queue: block}, process: one}
  back:
    use: "dataflow.ros:Ros2Sink"
    inputs: {message: passed/passed}
    params: {topic: /back, type: %s, router: "%s"}
    live: {queue: block}
    process: one
"""


@contextmanager
def router() -> Iterator[str]:
    """A Zenoh router on loopback; gives its endpoint."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        yield endpoint


def message(kind: str, number: int) -> Message:
    """The messages that are sent: their number is in them."""
    if kind == "Text":
        return Text(stamp=time.time_ns(), text=f"{number:08}" + "x" * 992)
    data = np.zeros((480, 640, 3), np.uint8)
    data.reshape(-1)[:8] = np.frombuffer(f"{number:08}".encode(), np.uint8)
    return Image(stamp=time.time_ns(), frame="camera", data=data)


def peer(kind: str, type_: str, rate: float, seconds: float, endpoint: str) -> None:
    """The other process: sends, and counts what comes back; prints the result as JSON."""
    node = Ros2Node("peer", "/", 0, endpoint, {})
    hash_ = type_hash(type_, "jazzy") or ""
    losses, delays = Losses(), list[float]()
    sent_at: dict[int, float] = {}
    reader = reader_for("/back", type_, "jazzy")

    def came(data: bytes, attachment: bytes) -> None:
        now = time.perf_counter()
        losses.take(Attachment.decoded(attachment))
        if kind == "Text":
            number = int(data[8:16])
        else:
            image = reader.read(data, 0, 1)
            assert isinstance(image, Image)
            number = int(image.data.reshape(-1)[:8].tobytes())
        delays.append(now - sent_at[number])

    node.subscribe(node.end("MS", "/back", type_, hash_, Qos()), came)
    publisher = node.advertise("/out", type_, hash_, Qos())
    time.sleep(2.0)
    begin = time.perf_counter()
    for number in range(round(rate * seconds)):
        time.sleep(max(0.0, begin + number / rate - time.perf_counter()))
        data = written(message(kind, number), type_, "jazzy")[2]
        sent_at[number] = time.perf_counter()
        publisher.put(data)
    took = time.perf_counter() - begin
    time.sleep(2.0)
    own = psutil.Process().cpu_times()
    result = {
        "sent": publisher.sent,
        "took": took,
        "came": len(delays),
        "lost": losses.lost,
        "p50": statistics.median(delays) * 1e3,
        "p90": statistics.quantiles(delays, n=10)[-1] * 1e3,
        "cpu": own.user + own.system,
    }
    print(json.dumps(result))
    node.close()


def cpu_of_children() -> dict[int, tuple[str, float]]:
    """CPU seconds by process below this one, with what it runs."""
    found = {}
    for child in psutil.Process().children(recursive=True):
        try:
            used = child.cpu_times()
            found[child.pid] = (" ".join(child.cmdline()), used.user + used.system)
        except psutil.NoSuchProcess:
            continue
    return found


def measure(name: str, seconds: float, endpoint: str, folder: Path, *, apart: bool) -> Mapping[str, Any]:
    """Runs the graph, and the peer beside it."""
    kind, type_, rate = LOADS[name]
    text = GRAPH % (kind, type_, endpoint, type_, endpoint)
    graph = load_text(text.replace(", process: one", "").replace("    process: one\n", "") if apart else text)
    path = folder / f"{kind}.mcap"
    supervisor = Supervisor(RunPlan(graph, live=True, record=path, metadata={}))
    reports: list[RunReport] = []
    run = threading.Thread(target=lambda: reports.append(supervisor.run()))
    run.start()
    watcher = Ros2Node("watcher", "/", 0, endpoint, {})
    while not watcher.publishers("/back", 60):
        pass
    watcher.close()
    time.sleep(2.0)
    before = cpu_of_children()
    words = [__file__, "--peer", kind, type_, str(rate), str(seconds), endpoint]
    told = subprocess.run([sys.executable, *words], check=True, capture_output=True, text=True, timeout=300)
    after = cpu_of_children()
    result: dict[str, Any] = json.loads(told.stdout.splitlines()[-1])
    used = sum(cpu - before.get(pid, ("", 0.0))[1] for pid, (_, cpu) in after.items())
    supervisor.stop()
    run.join(120)
    report = reports[0]
    taken = report.summaries["taken"]
    verified = verify(path, graph=graph)
    return {
        **result,
        "graph_cpu": used,
        "taken": taken,
        "dropped": {op: drops for op, drops in report.drops.items() if drops},
        "identical": verified.identical,
        "load": os.getloadavg()[0],
    }


def latecomer(hash_: str, endpoint: str) -> bool:
    """Subscribes to what is latched; returns whether it comes."""
    node = Ros2Node("late", "/", 0, endpoint, {})
    came = threading.Event()
    end = node.end("MS", "/tf_static", "tf2_msgs/msg/TFMessage", hash_, Qos(transient_local=True, depth=1))
    node.subscribe(end, lambda data, attachment: came.set())
    found = came.wait(10)
    node.close()
    return found


def late_joiners(times: int, endpoint: str) -> tuple[int, int]:
    """Returns how many of so many late subscribers got what was latched: sources here, and subscribers of a sink."""
    transforms = Transforms(
        stamp=1,
        frames=("base",),
        child_frames=("lidar",),
        translations=np.zeros((1, 3)),
        rotations=np.array([[0.0, 0.0, 0.0, 1.0]]),
    )
    sink = Ros2Sink(topic="/tf_static", router=endpoint, durability="transient_local", depth=1)
    sink.setup()
    sink.process(transforms, None)
    here = there = 0
    hash_ = type_hash("tf2_msgs/msg/TFMessage", "jazzy") or ""
    for _ in range(times):
        source = topics.StaticTransforms(topic="/tf_static", router=endpoint)
        source.setup()
        here += source.static_outputs()["message"].child_frames == ("lidar",)
        source.close()
        there += latecomer(hash_, endpoint)
    sink.close()
    return here, there


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--late", type=int, default=100, help="late subscribers to try")
    parser.add_argument("--apart", action="store_true", help="a process for each operator, not one for all")
    parser.add_argument("--peer", nargs=5, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.peer:
        kind, type_, rate, seconds, endpoint = chosen.peer
        peer(kind, type_, float(rate), float(seconds), endpoint)
        return
    print(
        "| load | sent (rate) | received | lost, ROS side | overflow | back | p50, p90 ms | CPU of graph | identical |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with router() as endpoint, tempfile.TemporaryDirectory() as folder:
        for name in LOADS:
            r = measure(name, chosen.seconds, endpoint, Path(folder), apart=chosen.apart)
            taken = r["taken"]
            print(
                f"| {name} | {r['sent']:,} ({r['sent'] / r['took']:.0f} Hz) | {taken['received']:,} "
                f"| {taken['lost']:,} "
                f"| {taken['overflow']:,} | {r['came']:,} ({r['lost']:,} lost) | {r['p50']:.1f}, {r['p90']:.1f} "
                f"| {r['graph_cpu'] / r['took']:.2f} cores | {'yes' if r['identical'] else 'NO'} |"
            )
            print(f"dropped in the graph: {r['dropped'] or 'nothing'}; load average {r['load']:.1f}", file=sys.stderr)
        here, there = late_joiners(chosen.late, endpoint)
    print(f"\nlate subscribers of a latched topic: {here} of {chosen.late} here, {there} of {chosen.late} of a sink")


if __name__ == "__main__":
    main()
