"""Does verifying a whole recording take more memory, or more time a firing, the longer it is?

python benchmarks/long_verification.py --hours 1 4 --rate 5

Makes recordings of a source and seven light operators, four of them with a state, as a run writes them, and verifies
each as a whole. Prints firings per second of wall and of CPU time, the peak of memory of all processes together (PSS:
what they share counts once), and the ratios to the first. A tree in PYTHONPATH is verified with instead of this one.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
from long_recording import record_seed
from long_recording_operators import EPOCH, numbered

from dataflow.execution.snapshots import pack_state
from dataflow.messages import FeatureVector
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.layout import RESERVED_METADATA
from dataflow.records.firing import Emission, FiringRecord, decode_batch, encode_batch, encode_single
from dataflow.sync import FOREVER, MessageRef

STATEFUL, STATELESS = ("sum1", "sum2", "sum3", "sum4"), ("copy1", "copy2", "copy3")
OPERATORS = STATEFUL + STATELESS
PAIRS = list(zip(STATELESS, STATEFUL, strict=False))
SNAPSHOT_SECONDS = 600
LOOK_EVERY = 0.5
CHUNK_NS = 1_000_000_000
"""Event time after which a run writes what it has, however little that is."""
GRAPH = "\n".join(
    [
        "graph: long",
        "namespace: g",
        "operators:",
        '  pulse: {use: "long_recording_operators:Pulse"}',
        *(f'  {n}: {{use: "long_recording_operators:Sum", inputs: {{x: pulse/out}}}}' for n in STATEFUL),
        *(f'  {n}: {{use: "long_recording_operators:Copy", inputs: {{x: {m}/out}}}}' for n, m in PAIRS),
        "record: {snapshots: 600s}\n",
    ]
)
HERE = Path(__file__).resolve().parent
TREE = os.environ.get("PYTHONPATH", "")
"""A checkout to verify with, instead of the installed one."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Of one verification: firings, wall and CPU time (s), and memory of the processes (bytes) when it was largest."""

    firings: int
    wall: float
    cpu: float
    processes: list[int]


def make(out: Path, seed: Path, steps: int, rate: float) -> None:
    """Writes a recording of so many steps of the source, `rate` of them a second."""
    with Recording(seed) as recording:
        metadata = {n: v for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
        setups = dict(reversed(list(recording.firings())))
        extras = {name: info.metadata for name, info in recording.streams.items()}
    streams = {name: f"g/{name}/out" for name in ("pulse", *OPERATORS)}
    inputs = dict.fromkeys(STATEFUL, streams["pulse"])
    inputs |= {name: streams[maker] for name, maker in PAIRS}
    with RecordingWriter(out, metadata=metadata, namespace="g", chunk_seconds=1e9, overwrite=True) as writer:
        for stream in streams.values():
            extra = {key: extras[stream][key] for key in ("operator", "port")}
            writer.add_stream(stream, FeatureVector, extra=extra)
        for name, payload in setups.items():
            writer.write_firings(name, EPOCH, encode_batch([decode_batch(payload).records[0]]))
        index = dict.fromkeys(streams, 1)
        period, snapshots = round(1e9 / rate), max(1, round(SNAPSHOT_SECONDS * rate))
        flushed = EPOCH
        for k in range(steps):
            stamp = EPOCH + k * period
            given, made = numbered(stamp, k % 1000), numbered(stamp, (k + 1) % 1000)
            sent, summed = (Emission(k, stamp, m.digest()) for m in (given, made))
            for name, stream in streams.items():
                first = name == "pulse"
                record = FiringRecord(
                    name,
                    0,
                    index[name],
                    "fire",
                    stamp,
                    inputs={} if first else {"x": MessageRef(inputs[name], 0, k)},
                    outputs=(sent if first else summed,),
                    duration=20_000,
                )
                writer.write_firings(name, stamp, encode_single(record))
                index[name] += 1
                if name in STATEFUL and k % snapshots == 0:
                    state = {"state": pack_state({"calls": k + 1})}
                    snapshot = FiringRecord(name, 0, index[name], "snapshot", stamp, detail=state)
                    writer.write_firings(name, stamp, encode_batch([snapshot]))
                    index[name] += 1
                writer.write(stream, given if first else made, seq=k)
            if stamp - flushed >= CHUNK_NS:
                writer.flush()
                flushed = stamp
        for name in streams:
            last = FiringRecord(name, 0, index[name], "finish", FOREVER, outputs=(None,))
            writer.write_firings(name, EPOCH + steps * period, encode_batch([last], last=True))


def verified(path: Path, timeout: float) -> Figures:
    """Verifies a recording as a whole within `timeout` (s), and watches the memory of all processes."""
    command = [str(Path(sys.executable).with_name("dataflow")), "verify", str(path), "--json"]
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": os.pathsep.join([str(HERE), *filter(None, [TREE])])}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    most: list[int] = []
    with tempfile.TemporaryFile() as said, psutil.Popen(command, stdout=said, env=environment) as run:
        while run.poll() is None:
            sizes = []
            for process in [run, *run.children(recursive=True)]:
                with suppress(psutil.Error):  # it has ended meanwhile
                    sizes.append(process.memory_full_info().pss)
            most = max(most, sizes, key=sum)
            if time.monotonic() - began > timeout:
                run.kill()  # its workers end with it
                raise SystemExit(f"{path}: not verified within {timeout:g} s; peak {sum(most) / 1e6:.0f} MB so far")
            time.sleep(LOOK_EVERY)
        wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        said.seek(0)
        found = json.load(said)
    if run.returncode or not found["identical"]:
        raise SystemExit(f"{path}: exit code {run.returncode}, {found['culprits'] or found['operators']}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Figures(sum(o["verified"] for o in found["operators"]), wall, cpu, most)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 4.0])
    parser.add_argument("--rate", type=float, default=5.0, help="steps of the source a second")
    parser.add_argument("--timeout", type=float, default=3600.0, help="seconds that verifying one may take")
    parser.add_argument("--folder", type=Path, help="where the recordings are made, and stay")
    options = parser.parse_args()
    print("| hours | firings | file, MB | wall, s | firings/s | CPU, us a firing | peak memory, MB | by process, MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    all_of: list[Figures] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        seed = record_seed(Path(temporary), GRAPH)
        for hours in options.hours:
            path = folder / f"{hours:g}h.mcap"
            if not path.exists():
                make(path, seed, round(hours * 3600 * options.rate), options.rate)
            found = verified(path, options.timeout)
            all_of.append(found)
            each = ", ".join(f"{size / 1e6:.0f}" for size in found.processes)
            print(
                f"| {hours:g} | {found.firings:,} | {path.stat().st_size / 1e6:.0f} | {found.wall:.0f} "
                f"| {found.firings / found.wall:,.0f} | {found.cpu / found.firings * 1e6:.0f} "
                f"| {sum(found.processes) / 1e6:.0f} | {each} |",
                flush=True,
            )
    first = all_of[0]
    for hours, found in zip(options.hours[1:], all_of[1:], strict=True):
        more, further = sum(found.processes) - sum(first.processes), found.firings - first.firings
        wall = found.firings / found.wall * first.wall / first.firings
        cpu = found.firings / found.cpu * first.cpu / first.firings
        print(
            f"{hours:g} h against {options.hours[0]:g} h: {wall:.2f} times the firings a second, {cpu:.2f} times those "
            f"a second of CPU time; {more / further:+.1f} MB a million firings"
        )


if __name__ == "__main__":
    main()
