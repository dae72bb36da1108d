"""The reference page of the operators."""

from __future__ import annotations

from pathlib import Path

import pytest
from operators_page import graphs_of, markdown, section

from dataflow.graph.catalogue import BUILT_IN, Catalogue, discover
from dataflow.messages import PointCloud
from dataflow.operator import In, Operator, Out, Param

REMEDY = "run: python tools/operators_page.py > docs/operators.md"


@pytest.fixture(scope="module")
def found() -> Catalogue:
    return discover(BUILT_IN)


@pytest.fixture
def page(repository: Path) -> str:
    return (repository / "docs" / "operators.md").read_text(encoding="utf-8")


def test_operators_page_matches_the_declarations(found: Catalogue, page: str) -> None:
    if not found.failures:
        assert page == markdown(found), REMEDY
    for use, cls in found.operators.items():  # where an optional package is missing, what can be imported
        assert section(use, cls) in page, REMEDY


def test_every_port_and_parameter_has_a_row_with_a_meaning(found: Catalogue, page: str) -> None:
    for cls in found.operators.values():
        rows = page.split(f"\n### {cls.spec.name}\n")[1].split("\n#")[0].splitlines()
        for name in (*cls.spec.inputs, *cls.spec.outputs, *cls.spec.parameters.model_fields):
            (row,) = [row for row in rows if row.startswith(f"| `{name}` |")]
            assert not row.endswith("|  |"), f"{cls.spec.name}.{name} has no documentation"


GEOMETRY = ["cloud", "depth", "evaluation", "frames", "fusion", "image", "localization", "mapping", "monitoring"]
GEOMETRY += ["odometry", "slam"]


def test_every_operator_of_geometry_stands_in_a_graph(found: Catalogue) -> None:
    graphs = graphs_of()
    geometry = [use for use in found.operators if use.split(".")[1].partition(":")[0] in GEOMETRY]
    assert [use for use in geometry if use not in graphs] == []


def test_operators_of_nested_graphs_are_counted_to_the_graph_that_holds_them() -> None:
    assert "perception_kitti.yaml" in graphs_of()["operators.monitoring:MotionCheck"]


def test_an_operator_that_a_parameter_names_is_the_one_that_is_run() -> None:
    graphs = graphs_of()
    assert graphs["operators.recognition:LearnedDetector"] == ["learned.yaml"]
    assert "perception.yaml" in graphs["operators.detection:OnnxDetector"]
    assert "learned.yaml" not in graphs["operators.detection:OnnxDetector"]
    assert not [use for use in graphs if "$" in use]


class Thinner(Operator):
    """Keeps a | share."""

    cloud: In[PointCloud] = In(doc="all | points")
    thin: Out[PointCloud] = Out(lag="1s", doc="fewer")
    share: float | None = Param(None, gt=0, doc="kept", unit="m")
    offset: tuple[float, float] = Param((0.0, 0.0), doc="x, y", unit="m")

    def process(self, cloud: PointCloud) -> PointCloud:
        return cloud


def test_declarations_cannot_break_the_tables() -> None:
    lines = section("my:Thinner", Thinner).splitlines()

    assert r"| `cloud` | In | [PointCloud](messages.md#pointcloud) | all \| points |" in lines
    assert "| `thin` | Out | [PointCloud](messages.md#pointcloud) | fewer (up to 1s late) |" in lines
    assert [line for line in lines if line.startswith("| `share`")] == [
        r"| `share` | `float \| None` | `null` m | kept |"
    ]
    assert "Fires on every message of cloud." in lines


def test_a_default_that_would_fill_its_column_is_cut_to_its_first_entry(page: str) -> None:
    (row,) = [line for line in page.splitlines() if line.startswith("| `color_camera` |")]
    assert '| `{"rate": 10.0, …}` |' in row
