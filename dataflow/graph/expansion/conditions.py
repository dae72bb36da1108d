"""`when:` of an operator: true, false, or which inputs of its graph must be given or must not."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.graph.drafts import Choice, GraphInput, Pattern
from dataflow.graph.expansion.wiring import OR
from dataflow.graph.problems import Problems, did_you_mean
from dataflow.graph.yaml.tree import UNKNOWN, Items, Leaf, Tree, describe

NOT = "not "


def failed(tree: Tree | None, inputs: Mapping[str, GraphInput], problems: Problems) -> str | None:
    """The condition that does not hold, as it is written, or None where all do; reports what is none."""
    if tree is None:
        return None
    for leaf in tree.items if isinstance(tree, Items) else (tree,):
        if isinstance(leaf, Leaf) and (leaf.value is True or leaf.value is UNKNOWN):
            continue
        if isinstance(leaf, Leaf) and leaf.value is False:
            return "false"
        if not (isinstance(leaf, Leaf) and isinstance(leaf.value, str)):
            what = f"when must be true, false or inputs of this graph, not {describe(leaf)}"
            problems.add(leaf.place, what, "such as 'imu', 'not imu' or 'imu | wheels', or a list of these")
        else:
            words = [_holds(word.strip(), leaf, inputs, problems) for word in leaf.value.split(OR)]
            if not any(words):
                return leaf.value
    return None


def _holds(word: str, leaf: Leaf, inputs: Mapping[str, GraphInput], problems: Problems) -> bool:
    name = word.removeprefix(NOT).strip()
    if name not in inputs:
        hint = did_you_mean(name, inputs, "its inputs") if inputs else "this graph has no inputs"
        problems.add(leaf.place, f"when: {name!r} is no input of this graph", hint)
        return True
    return any(given(choice) for choice in inputs[name].choices) != word.startswith(NOT)


def given(entry: Choice | Pattern) -> bool:
    """Tells whether an outer graph has given something, whatever becomes of what makes it."""
    if isinstance(entry, Pattern):
        return True
    return any(given(inner) for way in entry.ways for inner in way)
