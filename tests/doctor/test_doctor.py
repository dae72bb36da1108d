"""The look at a machine names what is missing, and what would mend it."""

from __future__ import annotations

import json
import os
import socket
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.doctor import libraries, machine
from dataflow.doctor.finding import Finding, State
from dataflow.doctor.libraries import check_loading, check_versions, load, unmet


def named(findings, about: str) -> Finding:
    return next(finding for finding in findings if finding.about == about)


@pytest.mark.parametrize(
    ("installed", "bounds", "broken"),
    [
        ("1.10.3", ">=1.10,<1.11", None),
        ("1.11.0", ">=1.10,<1.11", "<1.11"),
        ("1.9", ">=1.10", ">=1.10"),
        ("5", ">=5", None),
        ("2.0.0", "<2", "<2"),
        ("2.7.1+cpu", ">=2.5", None),
        ("3", "", None),
    ],
)
def test_versions_are_compared_with_their_bounds(installed: str, bounds: str, broken: str | None) -> None:
    assert unmet(installed, bounds) == broken


def test_missing_packages_are_distinguished_from_missing_extras() -> None:
    def version(name: str) -> str:
        if name in ("gone", "also-gone", "open3d"):
            raise PackageNotFoundError(name)
        return {"old": "1.0"}.get(name, "9.9")

    declared = [
        "fine>=1",
        "gone>=3",
        "old>=2,<3",
        'open3d>=0.19; extra == "sim"',
        'also-gone>=1; extra == "dev"',
    ]
    found = list(check_versions(declared, version))

    assert named(found, "gone").state is State.FAULT
    assert named(found, "gone").hint == "pip install 'gone>=3'"
    assert "1.0 is installed; >=2 is needed" in named(found, "old").text
    assert named(found, "extra [sim]").state is State.NOTE
    assert named(found, "packages").text.startswith("1 installed")
    assert not [finding for finding in found if "dev" in finding.about]


def test_a_module_that_does_not_load_is_named_with_the_reason(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "broken_native.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    found = load(("json", "broken_native", "not_there_at_all"))
    assert found["json"] == ""
    assert found["not_there_at_all"] == "missing"
    finding = named(check_loading(found), "broken_native")
    assert (finding.state, "libGL.so.1" in finding.text) == (State.FAULT, True)
    assert not [f for f in check_loading({"torch": "missing"}) if f.state is not State.OK]


def test_library_that_ends_the_process_is_reported(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "ends_it.py").write_text("import os; os._exit(7)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert "exit code 7" in load(("ends_it",))["libraries"]


def test_a_port_that_is_taken_and_a_path_too_long_for_sockets_are_named(tmp_path: Path, monkeypatch) -> None:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = server.getsockname()[1]
        monkeypatch.setattr(machine, "VIEWER_PORTS", {port: "the viewer"})
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / ("x" * 90)))
        found = list(machine.check_ports())
    assert "in use" in named(found, f"port {port}").text
    assert named(found, "folder of running graphs").state is State.FAULT


def test_a_machine_without_shared_memory_has_a_fault(monkeypatch) -> None:
    def refuse(*_: object) -> int:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(os, "memfd_create", refuse)
    finding = named(machine.check_shared_memory(), "memfd")
    assert finding.state is State.FAULT
    assert "shared_memory: false" in finding.hint


def test_clocks_and_display_are_looked_at(monkeypatch) -> None:
    assert machine.lateness() >= 0
    monkeypatch.setattr(machine, "wall_clock", lambda: (False, 16.0))
    assert named(machine.check_clocks(), "wall clock").state is State.NOTE
    monkeypatch.setattr(machine, "wall_clock", lambda: (True, 0.002))
    assert "2 ms" in named(machine.check_clocks(), "wall clock").text
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "serve" in named(machine.check_display(), "window").hint


def test_the_command_prints_findings_for_people_and_programs(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(libraries, "load", lambda modules: {"numpy": "", "cv2": "ImportError: libGL"})

    told = CliRunner().invoke(app, ["doctor", "--json"])
    assert told.exit_code == 1
    found = json.loads(told.stdout)
    assert not found["ok"]
    assert {"group", "about", "state", "text", "hint"} == set(found["findings"][0])
    people = CliRunner().invoke(app, ["doctor"])
    assert "fault   cv2: does not load: ImportError: libGL" in people.stdout
