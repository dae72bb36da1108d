"""Reads `inputs:` of a file as choices among key expressions: `camera/image`, `*/image`, `fused/pose | pose`."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.graph.drafts import Choice, GraphInput, Pattern, Scope
from dataflow.graph.keys import canonical, has_wildcard, key_fault
from dataflow.graph.problems import Place, Problems, did_you_mean
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.tree import Items, Leaf, Tree

OR = "|"
"""Stands between streams of which the first that is there is taken."""


class Wiring:
    """Reads `inputs:` of operators and nested graphs; `inputs` are those of the graph that they stand in."""

    def __init__(self, fields: Fields, problems: Problems) -> None:
        self.fields, self.problems = fields, problems

    def read(
        self, tree: Tree | None, scope: Scope, inputs: Mapping[str, GraphInput]
    ) -> dict[str, tuple[Place, list[Choice]]]:
        """Input port → (place of its key, what is to be chosen among)."""
        table = self.fields.table(tree, "inputs")
        wired = {}
        for port, entry in (table.entries if table else {}).items():
            if isinstance(entry.value, Items) and not entry.value.items:
                self.problems.add(entry.value.place, f"input {port!r} lists no stream", "leave the input out")
            leaves = self.fields.texts(entry.value, f"input {port!r}")
            wired[port] = (entry.key.place, [self.choice(leaf, scope, inputs) for leaf in leaves])
        return wired

    def choice(self, leaf: Leaf, scope: Scope, inputs: Mapping[str, GraphInput]) -> Choice:
        """One text of an input: a key expression, an input of this graph, or several of them between `|`."""
        words = [word.strip() for word in leaf.value.split(OR)]
        ways: list[tuple[Pattern | Choice, ...]] = []
        for word in words:
            if word in inputs:
                ways.append(inputs[word].choices)
            elif (pattern := read_pattern(Leaf(word, leaf.place, word), scope.key, self.problems, inputs)) is not None:
                if len(words) > 1 and has_wildcard(pattern.key):
                    self.problems.add(leaf.place, f"{word!r}: streams between '|' are named without wildcards")
                ways.append((pattern,))
        bound = any(word in inputs for word in words)
        return Choice(tuple(ways), via=leaf.place if bound else None)


def read_pattern(
    leaf: Leaf, scope: str, problems: Problems, inputs: Mapping[str, GraphInput] | None = None
) -> Pattern | None:
    """A text as a key expression, relative to the key prefix `scope`; `inputs`: of the graph that it stands in."""
    text = leaf.value
    absolute = text.startswith("/")
    if fault := key_fault(text[1:] if absolute else text):
        problems.add(leaf.place, f"{text!r} is no key expression: {fault}")
        return None
    if not absolute and "/" not in text and not has_wildcard(text) and inputs:
        hint = did_you_mean(text, inputs, "inputs of this graph")
        problems.add(leaf.place, f"{text!r} is neither an input of this graph nor 'operator/port'", hint)
        return None
    return Pattern(text, canonical(text[1:] if absolute else f"{scope}/{text}"), leaf.place, scope)
