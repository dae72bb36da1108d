"""docs/simulator.md says what the code says."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from operators.simulator import events, settings
from operators.simulator.classes import ACTIVITIES, THINGS, VOID
from operators.simulator.relations import PLACEMENT, SPATIAL
from operators.simulator.worlds.make import NAMES

PAGE = (Path(__file__).parents[3] / "docs" / "simulator.md").read_text(encoding="utf-8")
SECTIONS: dict[str, type[BaseModel]] = {
    "## Sensors and their faults": settings.Camera,
    "### `color_camera`": settings.ColorCamera,
    "### `depth_camera`": settings.DepthCamera,
    "### `stereo`": settings.StereoRig,
    "### `lidar`": settings.Lidar,
    "### `inertial`": settings.Inertial,
    "### `magnetometer`": settings.Magnetometer,
    "### `wheels`": settings.Wheels,
    "### `radar`": settings.Radar,
    "### `landmarks`": settings.Landmarks,
    "### `gnss`": settings.Gnss,
    "### `truth`": settings.Truth,
    "### `motion`": settings.Motion,
    "### `faults`": events.Fault,
    "### `lighting`": events.Lighting,
    "### `kidnaps`": events.Kidnap,
}


def section(heading: str) -> str:
    """The text below a heading up to the next one."""
    return re.split(r"^#", PAGE.split(f"\n{heading}\n")[1], flags=re.MULTILINE)[0]


@pytest.mark.parametrize("heading", SECTIONS)
def test_the_page_has_every_parameter_with_its_default_and_meaning(heading: str) -> None:
    model = SECTIONS[heading]
    shared: set[str] = set() if model is settings.Camera else set(settings.Camera.model_fields)
    expected = [
        f"| `{name}` | {'' if field.is_required() else f'`{json.dumps(field.default)}` '}| {field.description} |"
        for name, field in model.model_fields.items()
        if name not in shared
    ]
    assert [line for line in section(heading).splitlines() if line.startswith("| `")] == expected


def test_the_page_names_all_worlds_classes_activities_and_relations() -> None:
    rows = re.findall(r"^\| (`[^|]+) \|", section("## Activities and goals"), flags=re.MULTILINE)
    assert rows == [f"`{name}`" for name in ACTIVITIES]
    assert re.findall(r"^\| `(\w+)`", section("## Worlds"), flags=re.MULTILINE)[1:] == list(NAMES)
    assert ", ".join(f"`{name}`" for name in THINGS) in PAGE
    assert f"the class {VOID}," in PAGE
    words = re.findall(r"^\| (`[^|]+) \|", section("## Relations"), flags=re.MULTILINE)
    assert ", ".join(words).replace("`", "").split(", ") == [*PLACEMENT, *SPATIAL]
