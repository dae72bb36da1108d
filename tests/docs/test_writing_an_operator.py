"""The tutorial's code does what the tutorial says."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.testing import CliRunner

import dataflow
from dataflow.cli import plugins
from dataflow.cli.main import app
from dataflow.graph import GraphError, load_text
from dataflow.messages import Number, Odometry, Point
from dataflow.testing import play
from operators.cloud import CloudBuilder
from operators.sources import SyntheticRgbd

Blocks = dict[str, list[str]]


@pytest.fixture
def blocks(repository: Path) -> Blocks:
    """The page's code blocks by language."""
    text = (repository / "docs" / "writing-an-operator.md").read_text(encoding="utf-8")
    found: Blocks = {"python": [], "yaml": []}
    for language, code in re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL):
        found.setdefault(language, []).append(code)
    return found


@pytest.fixture
def my_robot(blocks: Blocks) -> Iterator[ModuleType]:
    """The Python blocks as the module that the page says they are in."""
    module = ModuleType("my_robot")
    sys.modules["my_robot"] = module
    exec(compile("\n".join(blocks["python"]), "my_robot.py", "exec"), vars(module))
    yield module
    del sys.modules["my_robot"]


def test_its_tests_pass(my_robot: ModuleType) -> None:
    tests = [value for name, value in vars(my_robot).items() if name.startswith("test_")]
    assert len(tests) == 3
    for test in tests:
        test()


def test_its_graph_is_correct_and_finds_real_mistakes(my_robot: ModuleType, blocks: Blocks) -> None:
    (text,) = blocks["yaml"]
    graph = load_text(text)
    assert graph.nodes["obstacle"].params == {"min_range": 0.3}
    with pytest.raises(GraphError, match="min_rang"):
        load_text(text.replace("min_range", "min_rang"))


def test_its_operator_works_in_that_chain(my_robot: Any) -> None:
    camera = play(SyntheticRgbd(frames=3, width=96, height=72))
    infos = ("depth_info", "image_info")
    cloud = play(CloudBuilder(stride=4), {port: camera[port] for port in ("depth", "image", *infos)}, static=infos)
    nearest = play(my_robot.NearestObstacle(min_range=0.3), {"cloud": cloud["cloud"]})["nearest"]
    assert len(nearest) == 3
    for point in nearest:
        assert isinstance(point, Point)
        assert point.frame == cloud["cloud"][0].frame
        assert 0.3 < float((point.position**2).sum() ** 0.5) < 2.5  # the table stands within reach of the whole path


def test_its_command_reads_a_recording_of_its_graph(
    my_robot: ModuleType, blocks: Blocks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (command,) = (code for code in blocks["python"] if "my_commands.py" in code)
    entries = blocks["toml"][-1].replace("[project.entry-points.", "[").replace('"', "")
    info = tmp_path / "my_robot-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_robot\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entries)
    (tmp_path / "my_commands.py").write_text(command)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_commands", raising=False)
    plugins.advertised.cache_clear()
    dataflow.run(load_text(blocks["yaml"][0].replace("frames: 30", "frames: 3")), record=tmp_path / "run.mcap")

    told = CliRunner().invoke(app, ["nearest", str(tmp_path / "run.mcap"), "--below", "5"])
    plugins.advertised.cache_clear()

    assert told.exit_code == 0, told.output
    assert re.findall(r"^0\.\d{3} s  [\d.]+ m$", told.stdout, re.MULTILINE) == told.stdout.splitlines()
    assert len(told.stdout.splitlines()) == 3


def test_its_first_step_needs_neither_stamp_nor_state(blocks: Blocks) -> None:
    first, *later = (code for code in blocks["python"] if code.startswith("# file:"))
    for word in ("stamp", "frame", "state", "context", "Sampled", "Batch", "every"):
        assert word not in first, word
    assert [step for step, word in enumerate(("state", "Sampled", "context"), 2) if word not in later[step - 2]] == []


def test_its_later_steps_work(my_robot: Any) -> None:
    second = 1_000_000_000
    points = [Point(stamp=k * second // 2, frame="lidar", position=[0, 3, 0]) for k in range(1, 6)]
    averaged = play(my_robot.MovingAverage(), {"value": [Number(stamp=k, value=k) for k in (1, 2, 3)]})["mean"]
    assert [(n.stamp, n.value) for n in averaged] == [(1, 1.0), (2, 1.5), (3, 2.0)]
    still = {"frame": "odom", "child_frame": "base", "position": [0, 0, 0], "orientation": [0, 0, 0, 1]}
    odometry = [Odometry(stamp=second - 1, linear=[1.5, 0, 0], **still), Odometry(stamp=2 * second, **still)]
    contact = play(my_robot.TimeToContact(), {"nearest": points, "odometry": odometry})
    assert [(n.stamp, n.value) for n in contact["contact"]] == [(second, 2.0)]
    assert set(contact.drops) == {("nearest", "no_sample"), ("nearest", "stale")}
    ages = play(my_robot.ObstacleAge(), {"nearest": points})["age"]
    assert [(n.stamp, n.value) for n in ages] == [(second, 0.0), (2 * second, 0.0)]
