"""Limits of the graph language: a file of a few lines must not cost more than a graph of thousands of operators may."""

from __future__ import annotations

from dataflow.graph.problems import Place, Problems

MAX_TEXT = 1_000_000
"""Characters of one file."""
MAX_BUNDLE = 16_000_000
"""Characters of a graph with its files, as a recording carries it."""
MAX_VALUES = 100_000
"""Values of one file, aliases expanded."""
MAX_NESTING = 64
"""Lists and mappings within one another."""
NESTED_TOO_DEEP = f"values nest deeper than {MAX_NESTING} levels"
MAX_DIGITS = 80
"""Characters of a whole number, in any notation; its value has 64 bits."""
MAX_DEPTH = 16
"""Graphs nested in one another."""
MAX_OPERATORS = 2_000
"""Operators and nested graphs of a graph, at all depths."""
MAX_EXPANDED = 300_000
"""Values of a graph after `${}` has been replaced, over all uses of all its files."""
MAX_EXPANDED_TEXT = 4_000_000
"""Characters that replacing `${}` inside texts may put in."""
REFERENCE_COST = 10
"""Values that one `${}` counts as: looking it up takes as long as taking over so many."""
SCALAR_COST = 60
"""The same for a default or an environment variable, which is read as YAML."""


class Budget:
    """Counts what replacing `${}` makes; beyond the limits it ends the loading of the graph with a `GraphError`."""

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._values = self._text = 0

    def charge(self, place: Place, values: int) -> None:
        self._values += values
        if self._values > MAX_EXPANDED:
            what = f"with every ${{}} replaced, the graph has more than {MAX_EXPANDED:,} values"
            self._problems.stop(place, what, "references and nested graphs multiply them")

    def charge_text(self, place: Place, characters: int) -> None:
        self._text += characters
        if self._text > MAX_EXPANDED_TEXT:
            what = f"${{}} inside texts puts in more than {MAX_EXPANDED_TEXT:,} characters"
            self._problems.stop(place, what, "references to texts with references multiply them")
