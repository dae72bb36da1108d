"""Cameras and serial devices of this machine, and the sources that read them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Device:
    """A device file, and `use` and `params` of the source that reads it."""

    kind: str
    path: str
    name: str
    """As the device calls itself; "" where it does not."""
    use: str
    params: dict[str, str | int]
    note: str = ""
    """A reason why it may give nothing."""

    def to_json(self) -> dict[str, object]:
        return asdict(self)

    @property
    def lines(self) -> str:
        """The source in a graph file."""
        params = ", ".join(f"{name}: {value}" for name, value in self.params.items())
        return f"use: {self.use}\nparams: {{{params}}}"


SERIAL = (
    "if it is a satellite receiver (NMEA 0183), at the rate that it has; an IMU with VectorNav's messages: "
    "use: operators.sources:VectorNavImu, baud: 115200"
)
"""A device file does not name what is connected to it."""


def find_devices(root: Path = Path("/")) -> list[Device]:
    """Returns the cameras, then the serial devices. `root` is the folder that holds `dev` and `sys`."""
    return [*_cameras(root), *_serial_devices(root)]


def _cameras(root: Path) -> Iterator[Device]:
    for file in sorted((root / "dev").glob("video[0-9]*"), key=lambda file: (len(file.name), file.name)):
        about = root / "sys/class/video4linux" / file.name
        note = _refused(file, "video")
        name = _text(about / "name")
        if _text(about / "index") not in ("", "0"):
            note = note or "further node of its device: may carry no images"
        elif "RealSense" in name:
            note = note or "with its depth: use: operators.sources:RealSense"
        yield Device("camera", str(file), name, "operators.sources:Webcam", {"input": str(file)}, note)


def _serial_devices(root: Path) -> Iterator[Device]:
    """Each by the path that stays the same when it is plugged in again, where there is one."""
    named = {link.resolve(): link for link in sorted((root / "dev/serial/by-id").glob("*")) if link.exists()}
    files = {file.resolve() for pattern in ("ttyUSB*", "ttyACM*") for file in (root / "dev").glob(pattern)}
    for file in sorted(files | named.keys()):
        path = named.get(file, file)
        name = _text((root / "sys/class/tty" / file.name / "device").resolve().parent / "product")
        params: dict[str, str | int] = {"input": str(path), "baud": 9600}
        note = _refused(file, "dialout") or SERIAL
        yield Device("serial", str(path), name, "operators.sources:NmeaGnss", params, note)


def _refused(file: Path, group: str) -> str:
    """The reason why this user cannot read a device, "" where it can."""
    return "" if os.access(file, os.R_OK | os.W_OK) else f"no permission: is the user in the group {group}?"


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:  # an attribute that this device lacks
        return ""
