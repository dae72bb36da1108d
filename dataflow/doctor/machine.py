"""The machine: system, memory that processes share, limits, folders, ports, clocks, GPU, display."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import resource
import shutil
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil

from dataflow.doctor.finding import Finding, State
from dataflow.recording.streams.facts import machine_facts
from dataflow.transport.registry import RegistryError, registry_folder, running

SHARED = 64 << 20
"""Bytes of shared memory that are tried: one pool."""
VIEWER_PORTS = {9876: "the viewer's data", 9090: "the viewer's page for browsers"}
LONGEST_SOCKET = 107
SOCKET_NAME = 40
"""Characters of the longest socket name in the folder of running graphs."""
LATE = 0.005
"""Seconds after which a thread that slept a millisecond is late for a live run."""
_UNSYNCHRONISED = 5
_STEADY_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "xen")


def check_system() -> Iterator[Finding]:
    group = "system"
    text = f"{platform.platform()}, Python {platform.python_version()}"
    if sys.platform != "linux":
        hint = "run and replay need Linux; recordings can be read here"
        yield Finding(group, "platform", State.FAULT, text, hint)
        return
    yield Finding(group, "platform", State.OK, text)
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    hint = "live runs will drop messages while the machine is this busy"
    yield _graded(group, "cores", load <= 2 * cores, f"{cores} to use, load {load:.1f}", hint)
    memory = psutil.virtual_memory()
    text = f"{_size(memory.available)} of {_size(memory.total)} available"
    yield _graded(group, "memory", memory.available >= 1 << 30, text)
    governor = _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor == "powersave":
        hint = "cpupower frequency-set -g performance"
        yield Finding(group, "frequency", State.NOTE, "the governor is powersave: firings take longer", hint)
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    hint = "ulimit -n 4096: each pair of processes that talk needs some"
    yield _graded(group, "open files", soft >= 1024, f"{soft} at most", hint)
    free = shutil.disk_usage(Path.cwd()).free
    yield _graded(group, "disk", free >= 1 << 30, f"{_size(free)} free in the current folder")


def check_shared_memory() -> Iterator[Finding]:
    """Tries what processes of a run need of each other: sealed anonymous memory, eventfd, pidfd."""
    group = "shared memory"
    try:
        descriptor = os.memfd_create("dataflow-doctor", os.MFD_ALLOW_SEALING)
        try:
            os.posix_fallocate(descriptor, 0, SHARED)
            os.pwrite(descriptor, b"!", SHARED - 1)
        finally:
            os.close(descriptor)
    except (AttributeError, OSError) as error:
        hint = "raise the memory limit of the container, or set network: {shared_memory: false}"
        yield Finding(group, "memfd", State.FAULT, f"{_size(SHARED)} cannot be had: {error}", hint)
    else:
        yield Finding(group, "memfd", State.OK, f"{_size(SHARED)} of anonymous memory was given and taken back")
    makers: dict[str, Callable[[], int]] = {
        "eventfd": lambda: os.eventfd(0),
        "pidfd": lambda: os.pidfd_open(os.getpid()),
    }
    for name, make in makers.items():
        try:
            os.close(make())
        except (AttributeError, OSError) as error:
            yield Finding(group, name, State.FAULT, str(error), "a Linux kernel from 5.3 on, without a filter on it")
        else:
            yield Finding(group, name, State.OK, "works")


def check_ports() -> Iterator[Finding]:
    group = "ports and sockets"
    try:
        folder = registry_folder()
        long = len(str(folder)) + SOCKET_NAME > LONGEST_SOCKET
        text = f"{folder} is this user's alone" + ("; its path is too long for sockets" if long else "")
        hint = "set XDG_RUNTIME_DIR to a folder with a short path"
        yield _graded(group, "folder of running graphs", not long, text, hint, State.FAULT)
        graphs = ", ".join(f"{graph.name} (process {graph.pid})" for graph in running())
        yield Finding(group, "running graphs", State.OK, graphs or "none")
    except RegistryError as error:
        yield Finding(group, "folder of running graphs", State.FAULT, str(error))
    for port, what in VIEWER_PORTS.items():
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                text = f"{what}: {error.strerror}"
                hint = "a viewer that is open has it; close it for --view spawn or serve"
                yield Finding(group, f"port {port}", State.NOTE, text, hint)
            else:
                yield Finding(group, f"port {port}", State.OK, f"{what}: free")


def check_clocks() -> Iterator[Finding]:
    group = "clocks"
    source = _read("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    if source:
        hint = "reading the time is slow; see the kernel's log for why tsc was left"
        yield _graded(group, "clock source", source in _STEADY_CLOCKS, source, hint)
    if (kept := wall_clock()) is not None:
        synchronised, error = kept
        if synchronised:
            yield Finding(group, "wall clock", State.OK, f"synchronised, off by {error * 1e3:.3g} ms at most")
        else:
            hint = "timedatectl set-ntp true, or chrony; timestamps of several machines do not compare without"
            yield Finding(group, "wall clock", State.NOTE, "the kernel does not know it to be synchronised", hint)
    worst = max(lateness() for _ in range(20))
    hint = "something keeps the cores busy: live sources will be late"
    yield _graded(group, "wake-up", worst <= LATE, f"a thread that sleeps wakes up to {worst * 1e3:.2f} ms late", hint)


def wall_clock() -> tuple[bool, float] | None:
    """Returns whether the kernel's clock is synchronised, and its largest error (s); None where unknown."""
    with contextlib.suppress(AttributeError, OSError):
        buffer = ctypes.create_string_buffer(512)  # struct timex, all zero: only read
        state = ctypes.CDLL(None, use_errno=True).adjtimex(buffer)
        if state >= 0:
            return state != _UNSYNCHRONISED, struct.unpack_from("@Illll", buffer.raw)[3] * 1e-6
    return None


def lateness() -> float:
    """Seconds by which a thread that sleeps a millisecond wakes up late."""
    begun = time.perf_counter()
    time.sleep(0.001)
    return max(time.perf_counter() - begun - 0.001, 0.0)


def check_gpu() -> Iterator[Finding]:
    group = "GPU"
    found = machine_facts()["device"]
    names = [value for key, value in found.items() if key.startswith("gpu ") and key != "gpu driver"]
    if names:
        yield Finding(group, "NVIDIA", State.OK, f"{', '.join(names)}; driver {found.get('gpu driver', 'unknown')}")
    else:
        yield Finding(group, "NVIDIA", State.NOTE, "no driver is loaded: networks run on the CPU")


def check_display() -> Iterator[Finding]:
    from dataflow.view.process import ViewerError, display_problem, executable

    group = "display"
    if (problem := display_problem()) is None:
        shown = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or sys.platform
        yield Finding(group, "window", State.OK, f"can be opened on {shown}")
    else:
        yield Finding(group, "window", State.NOTE, problem, "--view serve (a browser) and --view FILE.rrd need none")
    try:
        yield Finding(group, "viewer", State.OK, f"Rerun's program is at {executable()}")
    except ViewerError as error:
        yield Finding(group, "viewer", State.WARNING, str(error))


def _graded(group: str, about: str, fine: bool, text: str, hint: str = "", worse: State = State.WARNING) -> Finding:
    """A finding that is `worse`, with a hint, unless all is fine."""
    return Finding(group, about, State.OK, text) if fine else Finding(group, about, worse, text, hint)


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _size(nbytes: float) -> str:
    return f"{nbytes / (1 << 30):.1f} GiB" if nbytes >= 1 << 30 else f"{nbytes / (1 << 20):.0f} MiB"
