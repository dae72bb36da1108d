"""`dataflow doctor` and `dataflow devices`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import typer
from rich.text import Text

from dataflow.cli.support.arguments import Json
from dataflow.cli.support.output import DIFFERENT, out, plural, print_json

if TYPE_CHECKING:
    from dataflow.doctor.finding import Finding

_STYLES = {"ok": "green", "note": "dim", "warning": "yellow", "fault": "bold red"}


def doctor(json: Json = False) -> None:
    """Look at this machine and this installation: what is there, what is missing, what would mend it.

    Libraries and their versions, shared memory, sockets and ports, clocks, GPU, display. Nothing is changed. Exit code
    1: with a fault, by which graphs do not run.

    Examples:

      dataflow doctor
      dataflow doctor --json
    """
    from dataflow.doctor import libraries, machine

    found: list[Finding] = []
    looks = (
        machine.check_system,
        machine.check_shared_memory,
        machine.check_ports,
        machine.check_clocks,
        machine.check_gpu,
        machine.check_display,
        libraries.check_libraries,
    )
    for look in looks:
        more = list(look())
        found += more
        if not json:
            _print(more)
    faults = sum(finding.state == "fault" for finding in found)
    warnings = sum(finding.state == "warning" for finding in found)
    if json:
        print_json({"ok": not faults, "findings": [finding.to_json() for finding in found]})
    elif faults or warnings:
        out.print(Text(f"{plural(faults, 'fault')}, {plural(warnings, 'warning')}", style="bold"))
    else:
        out.print(Text("nothing stands in the way", style="green"))
    if faults:
        raise typer.Exit(DIFFERENT)


def devices(json: Json = False) -> None:
    """List the cameras and serial devices of this machine, each with the source that reads it.

    Nothing is opened, so that a device may still give nothing.

    Examples:

      dataflow devices
      dataflow devices --json
    """
    from dataflow.doctor.devices import find_devices

    found = find_devices()
    if json:
        print_json([device.to_json() for device in found])
        return
    if not found:
        out.print("no cameras (/dev/video*), no serial devices (/dev/serial/by-id, /dev/ttyUSB*, /dev/ttyACM*)")
    for device in found:
        out.print(Text.assemble((device.kind, "bold"), f"  {device.path}  {device.name}".rstrip()), soft_wrap=True)
        for line in device.lines.splitlines():
            out.print(Text(f"  {line}"), soft_wrap=True)
        if device.note:
            out.print(Text(f"  → {device.note}", style="dim"), soft_wrap=True)


def _print(findings: Iterable[Finding]) -> None:
    group = ""
    for finding in findings:
        if finding.group != group:
            group = finding.group
            out.print(Text(group, style="bold"))
        line = Text.assemble("  ", (f"{finding.state:<8}", _STYLES[finding.state]), f"{finding.about}: {finding.text}")
        out.print(line, soft_wrap=True)
        if finding.hint:
            out.print(Text(f"          → {finding.hint}", style="dim"), soft_wrap=True)
