"""From graph files to one flat list of operators: nested graphs unfolded, `${}` and `--set` applied, classes found.

What comes out names operators by their full names and still has inputs as key expressions; `resolve` wires them.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pydantic

from dataflow.graph.drafts import Absence, Alias, Choice, Expansion, GraphInput, OperatorDraft, Pattern, Scope
from dataflow.graph.expansion.graph_parameters import GraphParameters
from dataflow.graph.expansion.settings import Setting, overridden, read_settings
from dataflow.graph.expansion.wiring import OR, Wiring
from dataflow.graph.keys import NAME_RULE, has_wildcard, key_fault, name_fault
from dataflow.graph.lookup import NotFound, find_operator
from dataflow.graph.model import current_path
from dataflow.graph.problems import Place, Problems, did_you_mean
from dataflow.graph.yaml import document
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.limits import MAX_DEPTH, MAX_OPERATORS, Budget
from dataflow.graph.yaml.references import substitute
from dataflow.graph.yaml.tree import UNKNOWN, Entry, Items, Leaf, Table, Tree, at, describe, plain, unknown
from dataflow.messages.base import Message, message_types
from dataflow.operator import Operator

NOT = "not "
TOP_KEYS = (
    "graph", "namespace", "params", "inputs", "operators", "outputs", "record", "view", "seed", "threads", "network",
)  # fmt: skip
OPERATOR_KEYS = ("use", "when", "inputs", "params", "process", "machine", "env", "live", "sync")
NESTED_KEYS = ("use", "when", "inputs", "params", "process", "machine", "env")
OPTIONAL = "?"
"""Ends the type of an input of a nested graph that need not be given."""
ReadFile = Callable[[str], str]
"""Text of a graph file by its path relative to the root file's folder; raises OSError or UnicodeDecodeError."""


def operator_parameters(
    full: str, cls: type[Operator], given: Table, place: Place, problems: Problems
) -> dict[str, Any]:
    """Returns the values of an operator's parameters as plain values; faults go to `problems`.

    `full`: the operator's name; `place`: where a parameter that is missing is reported.
    """
    known = {key: e for key, e in given.entries.items() if not unknown(e.value)}
    reported = given.entries.keys() - known.keys()
    try:
        values = cls.spec.parameters(**plain(Table(known, given.place)))
    except pydantic.ValidationError as error:
        for fault in error.errors():
            if fault["loc"][:1] not in {(name,) for name in reported}:
                _report(full, cls, fault, given, place, problems)
        return {}
    except Exception as error:  # a parameter type's own validator may raise anything
        problems.add(given.place, f"{full}: {type(error).__name__}: {error}")
        return {}
    return values.model_dump(mode="json")


def _report(full: str, cls: type[Operator], fault: Any, given: Table, place: Place, problems: Problems) -> None:
    fields = cls.spec.parameters.model_fields
    path = tuple(fault["loc"])
    name = ".".join(map(str, path))
    match fault["type"]:
        case "extra_forbidden" if len(path) == 1 and name in given.entries:
            hint = did_you_mean(name, fields, f"parameters of {cls.__name__}")
            key = given.entries[name].key.place
            problems.add(key, f"{full}: {cls.__name__} has no parameter {name!r}", hint)
        case "missing" if len(path) == 1:
            doc = fields[name].description or ""
            problems.add(place, f"{full}: parameter {name!r} must be given", f"{name}: {doc}")
        case _:
            value = at(given, path)
            message = str(fault["msg"]).removeprefix("Value error, ")
            message = message[:1].lower() + message[1:]
            if fault["type"].endswith("_parsing") or fault["type"] == "int_from_float":
                message = message.partition(", ")[0]  # what it got stands behind it anyway
            hint = f"{path[0]}: {fields[str(path[0])].description}" if path and str(path[0]) in fields else ""
            if fault["type"] == "string_type" and isinstance(value, Leaf) and not isinstance(value.value, str):
                hint = f"write '{value.raw}' in quotes"
            elif fault["type"] in ("literal_error", "enum") and isinstance(value, Leaf):
                hint = did_you_mean(str(value.value), re.findall(r"'([^']*)'", message)) or hint
            said = value.raw if isinstance(value, Leaf) else describe(value)
            problems.add(value.place, f"{full}: parameter {name!r}: {message}, got {said}", hint)


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
    """Returns whether an outer graph has given something, whatever becomes of what makes it."""
    if isinstance(entry, Pattern):
        return True
    return any(given(inner) for way in entry.ways for inner in way)


class Expander:
    """Unfolds a root file. `shown(path)` is how a file is called in messages, `folder()` the root file's folder."""

    def __init__(
        self,
        read: ReadFile,
        shown: Callable[[str], str],
        variable: Callable[[str], str | None],
        folder: Callable[[], str],
        settings: Sequence[str],
        problems: Problems,
    ) -> None:
        self.read, self.shown, self.problems = read, shown, problems
        self.fields = Fields(problems)
        self.wiring = Wiring(self.fields, problems)
        self.budget = Budget(problems)
        self.graph_parameters = GraphParameters(variable, folder, self.fields, self.budget, problems)
        self.members = 0
        self.words = settings
        self.settings: list[Setting] = []
        self.parsed: dict[str, Tree | None] = {}
        self.found: dict[str, type[Operator] | NotFound] = {}
        self.out: Expansion

    def expand(self, file: str) -> Expansion | None:
        """The flat graph; None when the root file itself has no usable shape. Faults go to `problems`."""
        shown = self.shown(file)
        tree = self.parse(file, Place(shown, 1, 1))
        self.settings = read_settings(self.words, self.problems)
        if tree is None:
            return None
        scope = Scope(file, shown, "", "", {}, {}, None, None, None, None, (file,))
        table = self.top(tree, scope)
        if table is None:
            return None
        named = self.fields.label(table.get("graph"), "graph", "name")
        if "graph" not in table.entries:
            self.problems.add(table.place, "the graph has no name", "begin with 'graph: some_name'")
        name = named.value if named else "graph"
        self.out = Expansion(table, name, self.fields.namespace(table.get("namespace")) or name)
        self.body(table, replace(scope, key=self.out.namespace))
        self.unused_settings()
        return self.out

    # -- one file ------------------------------------------------------------------------------------------------

    def parse(self, file: str, blame: Place) -> Tree | None:
        if file not in self.parsed:
            self.parsed[file] = None
            shown = self.shown(file)
            try:
                text = self.read(file)
            except OSError as error:
                self.problems.add(blame, f"cannot read graph file {shown!r}: {error.strerror or error}")
                return None
            except UnicodeDecodeError as error:
                self.problems.add(blame, f"graph file {shown!r} is not UTF-8 text: {error.reason}")
                return None
            before = len(self.problems.found)
            tree = document.parse(text, shown, self.problems)
            if tree is None and len(self.problems.found) == before:
                self.problems.add(Place(shown, 1, 1), "the graph file is empty", "it needs at least 'operators:'")
            self.parsed[file] = tree
        return self.parsed[file]

    def top(self, tree: Tree, scope: Scope) -> Table | None:
        """The file's mapping with parameters put in; reports unknown keys."""
        table = self.fields.table(tree, "the graph file", TOP_KEYS)
        if table is None:
            return None
        declared, values = self.graph_parameters.values(table, scope, self.settings)
        rest = Table({k: e for k, e in table.entries.items() if k != "params"}, table.place)
        done = substitute(rest, self.graph_parameters.lookup(scope, declared, values), self.problems, self.budget)
        assert isinstance(done, Table)
        return done

    def body(self, table: Table, scope: Scope) -> None:
        inputs = self.graph_inputs(table, scope)
        operators = table.entries.get("operators")
        if operators is None:
            self.problems.add(table.place, "the graph has no operators", "add 'operators:' with at least one operator")
            return
        listed = self.fields.table(operators.value, "operators")
        if listed is None:
            return
        if not listed.entries:
            self.problems.add(listed.place, "the graph has no operators", "name at least one below 'operators:'")
        for name, entry in listed.entries.items():
            self.out.names.add(scope.prefix + name)
            if fault := name_fault(name):
                self.problems.add(entry.key.place, f"operator name {fault}", NAME_RULE)
                if key_fault(f"{scope.key}/{name}") is None and not has_wildcard(name):
                    self.out.broken.append(f"{scope.key}/{name}")
                continue
            self.operator(name, entry, scope, inputs)
        exported = self.fields.table(table.get("outputs"), "outputs")
        for name, entry in (exported.entries if exported else {}).items():
            if fault := name_fault(name):
                self.problems.add(entry.key.place, f"output name {fault}", NAME_RULE)
            elif self.fields.text(entry.value, f"output {name!r}") is not None and isinstance(entry.value, Leaf):
                target = self.wiring.choice(entry.value, scope, inputs)
                ways = [each for way in target.ways for each in way if isinstance(each, Pattern)]
                if any(has_wildcard(pattern.key) for pattern in ways):
                    self.problems.add(entry.value.place, f"output {name!r} must name one stream, not a wildcard")
                elif target.ways:
                    self.out.aliases.append(Alias(f"{scope.key}/{name}", target, entry.value.place))

    def graph_inputs(self, table: Table, scope: Scope) -> dict[str, GraphInput]:
        """The file's declared inputs with what the outer graph bound to them."""
        tree = table.get("inputs")
        declared: dict[str, tuple[Place, type[Message] | None]] = {}
        optional: set[str] = set()
        if isinstance(tree, Items):
            declared = {leaf.value: (leaf.place, None) for leaf in self.fields.texts(tree, "an input's name")}
        elif tree is not None and (named := self.fields.table(tree, "inputs")) is not None:
            for name, entry in named.entries.items():
                carried = entry.value
                if isinstance(carried, Leaf) and isinstance(carried.value, str) and carried.value.endswith(OPTIONAL):
                    optional.add(name)
                    carried = replace(carried, value=carried.value.removesuffix(OPTIONAL).strip())
                declared[name] = (entry.key.place, self.message_type(carried, name))
        if scope.use is None:
            hint = "a graph with inputs runs inside another graph: name this file there with 'use:'"
            for name, (place, _) in declared.items():
                self.problems.add(place, f"graph input {name!r} is bound to nothing", hint)
            return {name: GraphInput((), kind, place) for name, (place, kind) in declared.items()}
        for name, (place, _) in scope.bindings.items():
            if name not in declared:
                hint = did_you_mean(name, declared, "its inputs")
                self.problems.add(place, f"{scope.shown} has no input {name!r}", hint)
        inputs = {}
        for name, (place, kind) in declared.items():
            if fault := name_fault(name):
                self.problems.add(place, f"input name {fault}", NAME_RULE)
                continue
            bound = scope.bindings.get(name)
            choices = tuple(bound[1] if bound else ())
            if bound is None and name in optional:
                reason = f"{scope.prefix[:-1]} is not given its input {name!r}"
                choices = (Choice((), Absence(reason, scope.prefix)),)
            elif bound is None:
                wanted = f" ({kind.SCHEMA})" if kind else ""
                text = f"{scope.prefix[:-1]}: input {name!r}{wanted} of {scope.shown} is not given"
                self.problems.add(scope.use, text, f"add 'inputs: {{{name}: ...}}'", [(place, "declared here")])
            inputs[name] = GraphInput(choices, kind, place)
            self.out.graph_inputs.append((f"{scope.prefix}{name}", inputs[name]))
        return inputs

    def message_type(self, tree: Tree, name: str) -> type[Message] | None:
        if isinstance(tree, Leaf) and tree.value is None:
            return None
        schema = self.fields.text(tree, f"the type of input {name!r}")
        if schema is None:
            return None
        known = message_types()
        if schema not in known:
            self.problems.add(tree.place, f"unknown message type {schema!r}", did_you_mean(schema, known))
        return known.get(schema)

    # -- one operator --------------------------------------------------------------------------------------------

    def operator(self, name: str, entry: Entry, scope: Scope, inputs: Mapping[str, GraphInput]) -> None:
        full = scope.prefix + name
        self.members += 1
        if self.members > MAX_OPERATORS:
            what = f"the graph has more than {MAX_OPERATORS:,} operators"
            self.problems.stop(entry.key.place, what, "nested graphs multiply them")
        table = self.fields.table(entry.value, f"operator {full!r}")
        use_tree = table.get("use") if table else None
        use = self.fields.text(use_tree, "use")
        if table is None or use is None or use_tree is None:
            if table is not None and use_tree is None:
                self.fields.table(table, f"operator {full!r}", OPERATOR_KEYS)
                self.problems.add(entry.key.place, f"operator {full!r} has no 'use:'", "use: package.module:Class")
            self.out.broken.append(f"{scope.key}/{name}")
            return
        if use.endswith((".yaml", ".yml")):
            self.fields.table(table, f"the nested graph {full!r}", NESTED_KEYS)
            self.nested(name, use, use_tree.place, table, scope, inputs)
            return
        self.fields.table(table, f"operator {full!r}", OPERATOR_KEYS)
        if use not in self.found:
            self.found[use] = find_operator(use)
        cls = self.found[use]
        if isinstance(cls, NotFound):
            self.problems.add(use_tree.place, cls.message, cls.hint)
            self.out.broken.append(f"{scope.key}/{name}")
            for setting in self.settings:
                setting.used |= setting.owner == full
            return
        self.condition(full, table, scope, inputs)
        given, params = table.entries.get("inputs"), table.entries.get("params")
        tree = overridden(self.settings, full, params.value if params else None, entry.key.place)
        values = self.fields.table(tree, "params") or Table({}, entry.key.place)
        wired = self.wiring.read(table.get("inputs"), scope, inputs)
        self.out.drafts.append(
            OperatorDraft(
                name=full,
                place=entry.key.place,
                file=scope.file,
                use=current_path(use),
                cls=cls,
                params=operator_parameters(
                    full, cls, values, params.key.place if params else entry.key.place, self.problems
                ),
                choices={port: choices for port, (_, choices) in wired.items()},
                input_places={port: place for port, (place, _) in wired.items()},
                inputs_place=given.key.place if given else entry.key.place,
                process=self.fields.label(table.get("process"), "process") or scope.process,
                machine=self.fields.label(table.get("machine"), "machine") or scope.machine,
                env=self.fields.path(table.get("env"), "env") or scope.env,
                live=table.get("live"),
                sync=table.get("sync"),
            )
        )

    def condition(self, full: str, table: Table, scope: Scope, inputs: Mapping[str, GraphInput]) -> bool:
        """Notes an operator or nested graph whose `when:` does not hold; False for one."""
        fails = failed(table.get("when"), inputs, self.problems)
        if fails is not None:
            self.out.left_out[full] = (Absence(f"{full} has 'when: {fails}'", scope.prefix),)
        return fails is None

    def nested(
        self, name: str, use: str, place: Place, table: Table, scope: Scope, inputs: Mapping[str, GraphInput]
    ) -> None:
        full = scope.prefix + name
        file = posixpath.normpath(posixpath.join(posixpath.dirname(scope.file), use))
        prefix = f"{scope.key}/{name}"
        if not self.condition(full, table, scope, inputs):
            return
        if file in scope.stack or len(scope.stack) >= MAX_DEPTH:
            within = scope.stack[scope.stack.index(file) :] if file in scope.stack else ()
            way = " -> ".join(self.shown(f) for f in (*within, file))
            self.problems.add(
                place, f"graph nests in itself: {way}" if within else f"graphs nest deeper than {MAX_DEPTH}"
            )
            self.out.broken.append(prefix)
            return
        tree = self.parse(file, place)
        given = self.fields.table(overridden(self.settings, full, table.get("params"), place), "params")
        wired = self.wiring.read(table.get("inputs"), scope, inputs)
        inner = Scope(
            file=file,
            shown=self.shown(file),
            prefix=f"{full}/",
            key=prefix,
            given={key: e.value for key, e in given.entries.items()} if given else {},
            bindings=wired,
            use=place,
            process=self.fields.label(table.get("process"), "process") or scope.process,
            machine=self.fields.label(table.get("machine"), "machine") or scope.machine,
            env=self.fields.path(table.get("env"), "env") or scope.env,
            stack=(*scope.stack, file),
        )
        body = self.top(tree, inner) if tree is not None else None
        if body is None:
            self.out.broken.append(prefix)
        else:
            self.body(body, inner)

    # -- settings ------------------------------------------------------------------------------

    def unused_settings(self) -> None:
        root = next(iter(self.parsed.values()))
        params = root.get("params") if isinstance(root, Table) else None
        known = params.entries if isinstance(params, Table) else ()
        for setting in self.settings:
            if setting.used:
                continue
            if not setting.owner:
                hint = did_you_mean(setting.path[0], known, "graph parameters")
                self.problems.add(setting.place, f"the graph has no parameter {setting.path[0]!r}", hint)
            elif not self.is_broken(setting.owner):
                hint = did_you_mean(setting.owner, sorted(self.out.names), "operators")
                self.problems.add(setting.place, f"the graph has no operator {setting.owner!r}", hint)

    def is_broken(self, name: str) -> bool:
        """True for an operator that could not be had, or one inside a nested graph that could not."""
        key = f"{self.out.namespace}/{name}/"
        return any(key.startswith(f"{prefix}/") for prefix in self.out.broken)
