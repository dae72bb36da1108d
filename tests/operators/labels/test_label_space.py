"""Label spaces: roles and sizes by name, what a bad file is told, and that no code names a class."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from source_trees import nodes_of

from operators.detection.coco import COCO_CLASSES
from operators.labels import ROLES, LabelSpace, LabelSpaceError, labels_file
from operators.simulator.classes import THINGS

OWN = """
label_space: workshop
unit: cm
labels:
  vice: {aliases: [bench vice], roles: [support]}
  trolley:
    roles: [container, goal]
    sizes: [{size: [90, 45, 80], spread: [0.2, 0.1, 0.3], hidden_foot: 20}]
"""


def space(folder: Path, text: str = OWN) -> LabelSpace:
    file = folder / "own.yaml"
    file.write_text(text)
    return LabelSpace.read(file)


@pytest.mark.parametrize(("name", "classes"), [("coco", COCO_CLASSES), ("simulator", THINGS)])
def test_each_class_of_a_detector_has_an_entry(name: str, classes: tuple[str, ...]) -> None:
    labels = LabelSpace.read(Path(labels_file(name)))
    assert labels.name == name
    assert labels.unknown(classes) == []
    for label in classes:
        for prior in labels.sizes(label):
            assert prior.size[0] <= prior.size[1]
            assert max(prior.spread) <= math.log(2)


def test_a_file_of_ones_own_gives_roles_and_sizes_in_metres_by_all_names(tmp_path: Path) -> None:
    own = space(tmp_path)
    assert own.roles("vice") == own.roles("Bench_Vice") == {"support"}
    (prior,) = own.sizes("trolley")
    assert prior.size == pytest.approx((0.45, 0.9, 0.8))
    assert prior.spread == (0.1, 0.2, 0.3)
    assert prior.foot == pytest.approx(0.2)
    assert own.indices(("vice", "trolley", "book"), "goal") == [1]


def test_a_class_without_an_entry_has_no_roles_and_no_size(tmp_path: Path) -> None:
    own = space(tmp_path)
    assert own.unknown(("vice", "book")) == ["book"]
    assert own.roles("book") == frozenset()
    assert own.sizes("book") == ()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            OWN.replace("[support]", "[suport]"),
            r"labels\.vice\.roles\.0: Input should be 'agent'.*'support'.*not 'suport'",
        ),
        (OWN.replace("unit: cm\n", ""), r"own\.yaml is no label space: unit: Field required"),
        (OWN.replace("unit: cm", "unit: feet"), r"unit: Input should be 'm', 'cm' or 'mm', not 'feet'"),
        (OWN.replace("0.2, 0.1, 0.3", "0.2, 0.1"), r"labels\.trolley\.sizes\.0\.spread: .*at least 3 items"),
        (
            OWN.replace("[90, 45, 80]", "[90, -45, 80]"),
            r"labels\.trolley\.sizes\.0\.size\.1: .*greater than 0, not -45",
        ),
        (OWN.replace("roles", "rolls", 1), r"labels\.vice\.rolls: Extra inputs are not permitted"),
        (OWN.replace("bench vice", "trolley"), r"labels\.trolley: 'trolley' is there twice; name each class once"),
        (OWN + "  vice: {}\n", r"own\.yaml is no YAML: .*vice"),
        ("- vice\n", r"own\.yaml is no label space: the file: Input should be a valid dictionary"),
        ("labels: [\n", r"own\.yaml is no YAML"),
    ],
    ids=["role", "no unit", "unit", "two spreads", "negative", "key", "alias twice", "class twice", "list", "no YAML"],
)
def test_error_in_a_file_names_its_place_and_a_remedy(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(LabelSpaceError, match="(?s)" + told):
        space(tmp_path, text)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.yaml"):
        LabelSpace.read(tmp_path / "none.yaml")


@pytest.mark.long
@given(st.sampled_from(COCO_CLASSES), st.sampled_from([str.upper, str.title, lambda s: f" {s.replace(' ', '_')} "]))
def test_case_blanks_and_underscores_of_a_name_do_not_matter(name: str, written: object) -> None:
    assert callable(written)
    labels = LabelSpace.read(Path(labels_file("coco")))
    assert labels.roles(written(name)) == labels.roles(name)


def test_the_page_describes_each_role_and_its_example_is_a_label_space(repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "scene-graph.md").read_text(encoding="utf-8")
    example = page.split("```yaml\nlabel_space")[1].split("```")[0]
    assert space(tmp_path, f"label_space{example}").roles("trolley") == {"container", "goal"}
    for role, meaning in ROLES.items():
        assert f"| `{role}` | {meaning} |" in page


ORDINARY = frozenset(("clock", "robot", "train", "sink", "bus", "box", "table", "remote"))
"""Names of classes that are words of the engine, too: the clock of a run, the box of an object."""


def literals(file: Path) -> Iterator[str]:
    """Yields the strings of a module that are not docstrings."""
    told = {id(node.value) for node in nodes_of(file) if isinstance(node, ast.Expr)}
    for node in nodes_of(file):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told:
            yield node.value


@pytest.mark.parametrize("folder", ["dataflow", "operators/scene", "operators/recognition"])
def test_no_code_names_a_class(repository: Path, folder: str) -> None:
    names = {*COCO_CLASSES, *THINGS} - ORDINARY - {*ROLES}
    found = {
        f"{file.relative_to(repository)}: {text}"
        for file in sorted((repository / folder).rglob("*.py"))
        for text in literals(file)
        if text in names
    }
    assert found == set()
