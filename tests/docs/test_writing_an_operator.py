"""The tutorial's code does what the tutorial says."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from dataflow.graph import GraphError, load_text
from dataflow.messages import Pose
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
    assert len(tests) == 2
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
    for pose in nearest:
        assert isinstance(pose, Pose)
        assert 0.3 < float((pose.position**2).sum() ** 0.5) < 2.5  # the table stands within reach of the whole path
