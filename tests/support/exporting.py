"""Exports in one call."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource


def exported(
    path: Path, export: Callable[..., object], out: Path, streams: list[str] | None = None, **options: Any
) -> Exported:
    """What an export to `out` reports."""
    done = Exported()
    with ExportSource(path, streams) as source:
        export(source, out, done, **options)
    return done
