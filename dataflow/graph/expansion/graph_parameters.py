"""Parameters of a graph: their values, and what `${}` stands for where they are in force."""

from __future__ import annotations

import posixpath
from collections.abc import Callable, Iterable, Mapping, Sequence

from dataflow.graph.drafts import Scope
from dataflow.graph.expansion.settings import Setting
from dataflow.graph.keys import NAME_RULE, name_fault
from dataflow.graph.problems import Problems, did_you_mean
from dataflow.graph.yaml.document import parse_scalar
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.limits import REFERENCE_COST, SCALAR_COST, Budget
from dataflow.graph.yaml.references import Lookup, Reference, substitute
from dataflow.graph.yaml.tree import Leaf, Table, Tree

FOLDER = "graph:folder"
"""The reference that stands for the folder of the file it is written in."""


class GraphParameters:
    """Settles the parameters of graph files. `variable` looks up environment variables; `folder()` is the root file's
    folder."""

    def __init__(
        self,
        variable: Callable[[str], str | None],
        folder: Callable[[], str],
        fields: Fields,
        budget: Budget,
        problems: Problems,
    ) -> None:
        self.variable, self.folder = variable, folder
        self.fields, self.budget, self.problems = fields, budget, problems

    def values(self, table: Table, scope: Scope, settings: Iterable[Setting]) -> tuple[list[str], dict[str, Tree]]:
        """Names declared by the file, and their values: given from outside, or the default."""
        declared = self.fields.table(table.get("params"), "params")
        entries = declared.entries if declared else {}
        owner = scope.prefix[:-1]
        given = dict(scope.given)
        if not scope.prefix:
            for setting in settings:
                if not setting.owner and setting.path[0] in entries:
                    setting.used = True
                    given[setting.path[0]] = setting.value
        for name in given:
            if name not in entries:
                hint = did_you_mean(name, entries, "its parameters")
                self.problems.add(given[name].place, f"{owner} ({scope.shown}) has no parameter {name!r}", hint)
        values: dict[str, Tree] = {}
        seen: list[str] = []
        later = list(entries)
        for name, entry in entries.items():
            if fault := name_fault(name):
                self.problems.add(entry.key.place, f"parameter name {fault}", NAME_RULE)
            value = given.get(name, entry.value)
            if name not in given:  # what comes from outside is complete already
                value = substitute(value, self.lookup(scope, seen, values, later), self.problems, self.budget)
            seen.append(name)
            if not (isinstance(value, Leaf) and value.value is None):
                values[name] = value
        return seen, values

    def lookup(
        self, scope: Scope, declared: Sequence[str], values: Mapping[str, Tree], later: Sequence[str] = ()
    ) -> Lookup:
        """Answers `${...}` where `declared` names are in force."""

        def find(reference: Reference) -> Tree | None:
            self.budget.charge(reference.place, REFERENCE_COST)
            default = None
            if reference.default is not None:
                self.budget.charge(reference.place, SCALAR_COST)
                default = parse_scalar(reference.default, reference.place)
            if (variable := reference.variable) is not None:
                word = self.variable(variable)
                if word is not None:
                    self.budget.charge(reference.place, SCALAR_COST)
                    return parse_scalar(word, reference.place)
                if default is None:
                    hint = f"set it, or give a default: ${{env:{variable}:-default}}"
                    self.problems.add(reference.place, f"environment variable {variable!r} is not set", hint)
                return default
            name = reference.name
            if name == FOLDER:
                inner = posixpath.dirname(scope.file)
                folder = posixpath.join(self.folder(), inner) if inner else self.folder()
                return Leaf(folder, reference.place, folder)
            if name in values:
                return values[name]
            if name in declared:
                if default is None:
                    hint = f"give one: --set {name}=..., or a default below 'params:'"
                    self.problems.add(reference.place, f"graph parameter {name!r} has no value", hint)
                return default
            if name in later:
                text = f"graph parameter {name!r} is used before it is defined"
                self.problems.add(reference.place, text, "move it up in 'params:'")
            else:
                hint = did_you_mean(name, declared, "graph parameters")
                self.problems.add(reference.place, f"unknown graph parameter {name!r}", hint)
            return None

        return find
