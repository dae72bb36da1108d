"""The page about faults: the tests it names exist, and its plan is the one that is shipped and can be followed."""

from __future__ import annotations

import ast
import re
from itertools import islice
from pathlib import Path
from typing import get_args

from dataflow.chaos import kinds
from dataflow.chaos import plan as chaos
from dataflow.graph import load_graph
from dataflow.supervision.health import LEVELS


def page(repository: Path) -> str:
    return (repository / "docs" / "faults.md").read_text(encoding="utf-8")


def test_every_test_that_is_named_exists(repository: Path) -> None:
    named = set(re.findall(r"`(test_\w+)`", page(repository)))
    there = {
        node.name
        for folder in ("runtime", "process", "supervision", "transport", "simulation")
        for file in (repository / "tests" / folder).glob("test_*.py")
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }

    assert len(named) > 15
    assert named <= there, named - there


def test_the_plan_on_the_page_is_the_shipped_one_and_has_faults_of_every_kind(repository: Path) -> None:
    plan = repository / "graphs" / "chaos" / "plan.yaml"
    graph = load_graph(repository / "graphs" / "chaos" / "robot.yaml", live=True)

    assert f"```yaml\n{plan.read_text(encoding='utf-8')}```" in page(repository)
    faults = list(islice(chaos.load_plan(plan, graph), 200))
    known = {*kinds.TO_OPERATORS, *kinds.TO_SOURCES, *kinds.TO_PROCESSES, "malformed", "param"}
    assert {fault.kind for fault in faults} == known


def test_every_kind_of_fault_and_every_state_has_a_row(repository: Path) -> None:
    rows = set(re.findall(r"^\| `(\w+)` \|", page(repository), re.MULTILINE))
    entry, _ = get_args(chaos._Entry)
    kinds = {kind for model in get_args(entry) for kind in get_args(model.model_fields["kind"].annotation)}

    assert rows == kinds | set(LEVELS)
