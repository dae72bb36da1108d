"""Devices of a made machine: a folder with `dev` and `sys`."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

import operators.sources
from dataflow.cli.main import app
from dataflow.doctor import devices
from dataflow.doctor.devices import Device, find_devices


def machine(root: Path) -> None:
    for name in ("video0", "video1", "video10", "video2", "ttyUSB0", "ttyACM0", "ttyS0", "null"):
        (root / "dev").mkdir(exist_ok=True)
        (root / "dev" / name).touch()
    for name, index in (("video0", 0), ("video1", 1)):
        about = root / "sys/class/video4linux" / name
        about.mkdir(parents=True)
        (about / "name").write_text("HD Webcam C525\n")
        (about / "index").write_text(f"{index}\n")
    usb = root / "sys/devices/usb1/1-1"
    (usb / "1-1:1.0").mkdir(parents=True)
    (usb / "product").write_text("u-blox GNSS receiver\n")
    tty = root / "sys/class/tty/ttyACM0"
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(usb / "1-1:1.0")
    by_id = root / "dev/serial/by-id"
    by_id.mkdir(parents=True)
    (by_id / "usb-u-blox-if00").symlink_to("../../ttyACM0")
    (by_id / "usb-gone-if00").symlink_to("../../ttyACM7")


def test_cameras_and_serial_devices_are_found_by_their_names(tmp_path: Path) -> None:
    machine(tmp_path)
    found = find_devices(tmp_path)

    assert [(d.kind, d.path.removeprefix(f"{tmp_path}/dev/"), d.name) for d in found] == [
        ("camera", "video0", "HD Webcam C525"),
        ("camera", "video1", "HD Webcam C525"),
        ("camera", "video2", ""),
        ("camera", "video10", ""),
        ("serial", "serial/by-id/usb-u-blox-if00", "u-blox GNSS receiver"),
        ("serial", "ttyUSB0", ""),
    ]
    assert [d.note for d in found[:3]] == ["", "further node of its device: may carry no images", ""]


def test_sources_that_fit_a_device_better_or_as_well_are_noted(tmp_path: Path) -> None:
    machine(tmp_path)
    (tmp_path / "sys/class/video4linux/video0/name").write_text("Intel(R) RealSense(TM) Depth Camera 435i\n")
    notes = [device.note for device in find_devices(tmp_path)]

    assert notes[0] == "with its depth: use: operators.sources:RealSense"
    assert "use: operators.sources:VectorNavImu, baud: 115200" in notes[4]
    for name in ("RealSense", "VectorNavImu"):
        assert hasattr(operators.sources, name)


def test_the_lines_of_a_device_are_those_of_a_source(tmp_path: Path) -> None:
    machine(tmp_path)
    for device in find_devices(tmp_path):
        lines = YAML(typ="safe").load(device.lines)
        assert lines == {"use": device.use, "params": device.params}
        source = getattr(operators.sources, device.use.removeprefix("operators.sources:"))(**lines["params"])
        assert source.input == device.path


def test_device_without_read_permission_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine(tmp_path)
    monkeypatch.setattr(os, "access", lambda file, mode: False)

    notes = [device.note for device in find_devices(tmp_path)]
    assert (
        notes
        == ["no permission: is the user in the group video?"] * 4
        + ["no permission: is the user in the group dialout?"] * 2
    )


def test_the_command_prints_them_for_people_and_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Device("camera", "/dev/video0", "C525", "operators.sources:Webcam", {"input": "/dev/video0"}, "busy")
    monkeypatch.setattr(devices, "find_devices", lambda: [camera])
    people, programs = (CliRunner().invoke(app, ["devices", *more]) for more in ([], ["--json"]))

    assert people.stdout.splitlines() == [
        "camera  /dev/video0  C525",
        "  use: operators.sources:Webcam",
        "  params: {input: /dev/video0}",
        "  → busy",
    ]
    assert json.loads(programs.stdout) == [
        {
            "kind": "camera",
            "path": "/dev/video0",
            "name": "C525",
            "use": "operators.sources:Webcam",
            "params": {"input": "/dev/video0"},
            "note": "busy",
        }
    ]


def test_machine_without_devices_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = find_devices(tmp_path)
    monkeypatch.setattr(devices, "find_devices", lambda: nothing)
    people, programs = (CliRunner().invoke(app, ["devices", *more]) for more in ([], ["--json"]))

    assert "no cameras (/dev/video*), no serial devices" in people.stdout
    assert json.loads(programs.stdout) == []
