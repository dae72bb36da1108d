"""Memory of every process of a live run of three minutes, with a stopped viewer and a killed operator process.

usage: python benchmarks/endurance.py [--duration 190] [--samples FILE] [--json]

graphs/chaos/robot.yaml runs live, a process each, and is recorded. 20 s after its processes began `dataflow echo`
attaches to the decoded images, and is stopped (SIGSTOP) 5 s later; after 30 s the odometry's process is killed
(kill -9) and started again by its policy. Memory is the proportional set size (PSS), once a second; compared are the
medians of ten seconds: those around one minute, and the last ones before the sources end. Exit code 1 if a process grew
by more than 5 %, or if the recording does not verify as identical.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).resolve().parent.parent
GRAPH = ROOT / "graphs" / "chaos" / "robot.yaml"
DATAFLOW = [sys.executable, "-m", "dataflow.cli.main"]
ATTACH_AT, STOP_AT, KILL_AT, FIRST_AT, TAKEN_OVER = 20.0, 25.0, 30.0, 60.0, 10.0
LAST = 5.0
"""Seconds at the end that do not count: files are being closed."""
SETTINGS = (
    "robot.color_camera={rate: 5, width: 160, height: 120, output: jpeg}",
    "robot.depth_camera={rate: 5, output: png}",
)
KILLED = "odometry"
MOST_GROWTH = 0.05


def memory(run: psutil.Process) -> dict[str, int]:
    """The PSS in bytes of every process of a run by its name; the one that was started is the supervisor."""
    found = {"supervisor": run.memory_full_info().pss}
    for process in run.children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
            found[process.name()] = process.memory_full_info().pss
    return found


def median(samples: Sequence[tuple[float, int]], end: float) -> float | None:
    """The median of the samples of the ten seconds before `end`."""
    chosen = [size for moment, size in samples if end - TAKEN_OVER <= moment <= end]
    return statistics.median(chosen) if chosen else None


def kill(run: psutil.Process, name: str) -> None:
    """Kills a run's process by its name. Raises LookupError if there is none."""
    for process in run.children(recursive=True):
        if process.name() == name:
            process.kill()
            return
    raise LookupError(f"no process {name!r} to kill")


def observe(duration: float, recording: Path, report: Path) -> dict[str, list[tuple[float, int]]]:
    """Runs the graph, disturbs it, and returns per process its (seconds since the start, bytes)."""
    command = [*DATAFLOW, "run", str(GRAPH), "--live", "--process-each", "--quiet", "--json"]
    command += ["--record", str(recording), "--set", f"duration={duration:g}s"]
    command += [word for setting in SETTINGS for word in ("--set", setting)]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(recording.parent)}  # other graphs may run on this machine
    samples: dict[str, list[tuple[float, int]]] = defaultdict(list)
    stopped: subprocess.Popen[bytes] | None = None
    plan = {ATTACH_AT: "attach", STOP_AT: "stop", KILL_AT: "kill"}
    with report.open("w") as output, subprocess.Popen(command, stdout=output, cwd=ROOT, env=environment) as started:
        run, begin = psutil.Process(started.pid), None
        try:
            while started.poll() is None:
                sizes: dict[str, int] = {}
                with contextlib.suppress(psutil.NoSuchProcess):
                    sizes = memory(run)
                if begin is None and KILLED not in sizes:
                    time.sleep(0.1)
                    continue
                begin = begin or time.monotonic()
                now = time.monotonic() - begin
                for at in [at for at in plan if now >= at]:
                    what = plan.pop(at)
                    if what == "attach":
                        words = [*DATAFLOW, "echo", "color/image", "--wait", "30"]
                        stopped = subprocess.Popen(words, stdout=subprocess.DEVNULL, env=environment)
                    elif what == "stop" and stopped is not None:
                        stopped.send_signal(signal.SIGSTOP)
                    elif what == "kill":
                        kill(run, KILLED)
                for name, size in sizes.items():
                    samples[name].append((now, size))
                time.sleep(1.0)
        finally:
            if stopped is not None:
                stopped.kill()
                stopped.wait()
    if started.returncode != 0:
        raise SystemExit(f"the run ended with exit code {started.returncode}")
    return samples


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=190.0, help="seconds of the live run")
    parser.add_argument("--samples", type=Path, help="write every sample here: process, seconds, bytes")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    if arguments.duration < FIRST_AT + 2 * TAKEN_OVER:
        parser.error(f"--duration must be {FIRST_AT + 2 * TAKEN_OVER:g} s at least")
    with tempfile.TemporaryDirectory() as folder:
        recording, report = Path(folder) / "endurance.mcap", Path(folder) / "report.json"
        samples = observe(arguments.duration, recording, report)
        restarts = json.loads(report.read_text())["restarts"]
        verified = subprocess.run([*DATAFLOW, "verify", str(recording), "--quiet"], capture_output=True, cwd=ROOT)
    if arguments.samples is not None:
        lines = [f"{name},{moment:.1f},{size}" for name, taken in sorted(samples.items()) for moment, size in taken]
        arguments.samples.write_text("\n".join(["process,seconds,bytes", *lines]) + "\n")
    end = max(moment for taken in samples.values() for moment, _ in taken)
    rows: list[dict[str, Any]] = []
    for name, taken in sorted(samples.items()):
        early, late = median(taken, FIRST_AT + TAKEN_OVER / 2), median(taken, end - LAST)
        if early is not None and late is not None:
            rows.append({"process": name, "at 60 s, MB": early / 1e6, "at the end, MB": late / 1e6})
            rows[-1]["growth"] = late / early - 1
    grown = [row["process"] for row in rows if row["growth"] > MOST_GROWTH]
    identical = verified.returncode == 0
    if arguments.json:
        print(json.dumps({"processes": rows, "grown": grown, "restarts": restarts, "identical": identical}, indent=1))
    else:
        print(f"{'process':18} {'at 60 s':>9} {'at the end':>11} {'growth':>8}")
        for row in rows:
            early, late, growth = row["at 60 s, MB"], row["at the end, MB"], row["growth"]
            print(f"{row['process']:18} {early:6.1f} MB {late:8.1f} MB {growth:8.1%}")
        print(
            f"\nrestarts: {restarts}; verify: {'identical' if identical else 'NOT IDENTICAL'}; grown: {grown or 'none'}"
        )
    return 1 if grown or not identical else 0


if __name__ == "__main__":
    sys.exit(main())
