"""From graph files to one flat list of operators: nested graphs unfolded, `${}` and `--set` applied, classes found.

What comes out names operators by their full names and still has inputs as key expressions; `resolve` wires them.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pydantic

from dataflow.graph import document
from dataflow.graph.fields import Fields
from dataflow.graph.keys import NAME_RULE, canonical, has_wildcard, key_fault, name_fault
from dataflow.graph.limits import MAX_DEPTH, MAX_OPERATORS, REFERENCE_COST, SCALAR_COST, Budget
from dataflow.graph.lookup import NotFound, find_operator
from dataflow.graph.problems import Place, Problems, did_you_mean, nearest
from dataflow.graph.references import Lookup, Reference, substitute
from dataflow.graph.settings import Setting, put, read_settings
from dataflow.graph.tree import Entry, Items, Leaf, Table, Tree, at, describe, plain, unknown
from dataflow.messages.base import Message, message_types
from dataflow.operator import Operator

TOP_KEYS = (
    "graph", "namespace", "params", "inputs", "operators", "outputs", "record", "view", "seed", "threads", "network",
)  # fmt: skip
OPERATOR_KEYS = ("use", "inputs", "params", "process", "machine", "live", "sync")
NESTED_KEYS = ("use", "inputs", "params", "process", "machine")
FOLDER = "graph:folder"
"""The reference that stands for the folder of the file it is written in."""

ReadFile = Callable[[str], str]
"""Text of a graph file by its path relative to the root file's folder; raises OSError or UnicodeDecodeError."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """A key expression of an input: as written, absolute and canonical, and where it stands.

    `scope` is the key prefix that the written text is relative to; `via` the place inside a nested graph, when the
    expression was bound to a nested graph's input outside it.
    """

    text: str
    key: str
    place: Place
    scope: str
    via: Place | None = None


@dataclass(slots=True)
class Draft:
    """One operator before its inputs are wired."""

    name: str
    place: Place
    file: str
    use: str
    cls: type[Operator]
    params: dict[str, Any]
    inputs: dict[str, list[Pattern]]
    input_places: dict[str, Place]
    inputs_place: Place
    process: Leaf | None
    machine: Leaf | None
    live: Tree | None
    sync: Tree | None


@dataclass(frozen=True, slots=True)
class Alias:
    """An exported output of a nested graph: `key` stands for the stream that `target` matches."""

    key: str
    target: Pattern


@dataclass(frozen=True, slots=True)
class GraphInput:
    """A declared input of a nested graph, bound to expressions outside; `type` is what it promises to carry."""

    patterns: tuple[Pattern, ...]
    type: type[Message] | None
    place: Place
    """Where the nested graph declares it."""


@dataclass(slots=True)
class Expansion:
    """All that the files say, flat."""

    root: Table
    name: str
    namespace: str
    drafts: list[Draft] = field(default_factory=list)
    aliases: list[Alias] = field(default_factory=list)
    graph_inputs: list[tuple[str, GraphInput]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    """Key prefixes of operators that could not be had: nothing is said about streams below them."""
    names: set[str] = field(default_factory=set)
    """Full names of operators and nested graphs."""


@dataclass(frozen=True, slots=True)
class _Scope:
    """Says where in the nesting a file stands. `prefix` is "" or "front/"; `key` the absolute key prefix."""

    file: str
    shown: str
    prefix: str
    key: str
    given: Mapping[str, Tree]
    bindings: Mapping[str, tuple[Place, list[Pattern]]]
    use: Place | None
    process: Leaf | None
    machine: Leaf | None
    stack: tuple[str, ...]


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
        self.read, self.shown, self.variable, self.problems = read, shown, variable, problems
        self.folder = folder
        self.fields = Fields(problems)
        self.budget = Budget(problems)
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
        scope = _Scope(file, shown, "", "", {}, {}, None, None, None, (file,))
        table = self.top(tree, scope)
        if table is None:
            return None
        name = self.name(table.get("graph"), "graph")
        if "graph" not in table.entries:
            self.problems.add(table.place, "the graph has no name", "begin with 'graph: some_name'")
        namespace = self.namespace(table.get("namespace")) or name or "graph"
        self.out = Expansion(table, name or "graph", namespace)
        scope = _Scope(file, shown, "", namespace, {}, {}, None, None, None, (file,))
        self.body(table, scope)
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

    def top(self, tree: Tree, scope: _Scope) -> Table | None:
        """The file's mapping with parameters put in; reports unknown keys."""
        table = self.fields.table(tree, "the graph file", TOP_KEYS)
        if table is None:
            return None
        declared, values = self.parameters(table, scope)
        rest = Table({k: e for k, e in table.entries.items() if k != "params"}, table.place)
        done = substitute(rest, self.lookup(scope, declared, values), self.problems, self.budget)
        assert isinstance(done, Table)
        return done

    def body(self, table: Table, scope: _Scope) -> None:
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
                pattern = self.pattern(entry.value, scope)
                if pattern is not None and has_wildcard(pattern.key):
                    self.problems.add(pattern.place, f"output {name!r} must name one stream, not a wildcard")
                elif pattern is not None:
                    self.out.aliases.append(Alias(f"{scope.key}/{name}", pattern))

    def graph_inputs(self, table: Table, scope: _Scope) -> dict[str, GraphInput]:
        """The file's declared inputs with what the outer graph bound to them."""
        tree = table.get("inputs")
        declared: dict[str, tuple[Place, type[Message] | None]] = {}
        if isinstance(tree, Items):
            declared = {leaf.value: (leaf.place, None) for leaf in self.fields.texts(tree, "an input's name")}
        elif tree is not None and (named := self.fields.table(tree, "inputs")) is not None:
            for name, entry in named.entries.items():
                declared[name] = (entry.key.place, self.message_type(entry.value, name))
        if scope.use is None:
            for name, (place, _) in declared.items():
                self.problems.add(
                    place,
                    f"graph input {name!r} is bound to nothing",
                    "a graph with inputs runs inside another graph: name this file there with 'use:'",
                )
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
            if bound is None:
                wanted = f" ({kind.SCHEMA})" if kind else ""
                self.problems.add(
                    scope.use,
                    f"{scope.prefix[:-1]}: input {name!r}{wanted} of {scope.shown} is not given",
                    f"add 'inputs: {{{name}: ...}}'",
                    [(place, "declared here")],
                )
            inputs[name] = GraphInput(tuple(bound[1] if bound else ()), kind, place)
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
            near = nearest(schema, known)
            hint = f"did you mean {near!r}?" if near else ""
            self.problems.add(tree.place, f"unknown message type {schema!r}", hint)
        return known.get(schema)

    # -- parameters of a graph -----------------------------------------------------------------------------------

    def parameters(self, table: Table, scope: _Scope) -> tuple[list[str], dict[str, Tree]]:
        """Names declared by the file, and their values: given from outside, or the default."""
        declared = self.fields.table(table.get("params"), "params")
        entries = declared.entries if declared else {}
        owner = scope.prefix[:-1]
        given = dict(scope.given)
        if not scope.prefix:
            for setting in self.settings:
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
        self, scope: _Scope, declared: Sequence[str], values: Mapping[str, Tree], later: Sequence[str] = ()
    ) -> Lookup:
        """Answers `${...}` where `declared` names are in force."""

        def find(reference: Reference) -> Tree | None:
            self.budget.charge(reference.place, REFERENCE_COST)
            default = None
            if reference.default is not None:
                self.budget.charge(reference.place, SCALAR_COST)
                default = document.parse_scalar(reference.default, reference.place)
            if (variable := reference.variable) is not None:
                word = self.variable(variable)
                if word is not None:
                    self.budget.charge(reference.place, SCALAR_COST)
                    return document.parse_scalar(word, reference.place)
                if default is None:
                    self.problems.add(
                        reference.place,
                        f"environment variable {variable!r} is not set",
                        f"set it, or give a default: ${{env:{variable}:-default}}",
                    )
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
                    self.problems.add(
                        reference.place,
                        f"graph parameter {name!r} has no value",
                        f"give one: --set {name}=..., or a default below 'params:'",
                    )
                return default
            if name in later:
                self.problems.add(
                    reference.place, f"graph parameter {name!r} is used before it is defined", "move it up in 'params:'"
                )
            else:
                hint = did_you_mean(name, declared, "graph parameters")
                self.problems.add(reference.place, f"unknown graph parameter {name!r}", hint)
            return None

        return find

    # -- one operator --------------------------------------------------------------------------------------------

    def operator(self, name: str, entry: Entry, scope: _Scope, inputs: Mapping[str, GraphInput]) -> None:
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
        given = table.entries.get("inputs")
        wired = self.wiring(table.get("inputs"), scope, inputs)
        self.out.drafts.append(
            Draft(
                name=full,
                place=entry.key.place,
                file=scope.file,
                use=use,
                cls=cls,
                params=self.operator_parameters(full, cls, table, entry.key.place),
                inputs={port: patterns for port, (_, patterns) in wired.items()},
                input_places={port: place for port, (place, _) in wired.items()},
                inputs_place=given.key.place if given else entry.key.place,
                process=self.label(table.get("process"), "process") or scope.process,
                machine=self.label(table.get("machine"), "machine") or scope.machine,
                live=table.get("live"),
                sync=table.get("sync"),
            )
        )

    def nested(
        self, name: str, use: str, place: Place, table: Table, scope: _Scope, inputs: Mapping[str, GraphInput]
    ) -> None:
        full = scope.prefix + name
        file = posixpath.normpath(posixpath.join(posixpath.dirname(scope.file), use))
        prefix = f"{scope.key}/{name}"
        if file in scope.stack:
            way = " -> ".join(self.shown(f) for f in (*scope.stack[scope.stack.index(file) :], file))
            self.problems.add(place, f"graph nests in itself: {way}")
            self.out.broken.append(prefix)
            return
        if len(scope.stack) >= MAX_DEPTH:
            self.problems.add(place, f"graphs nest deeper than {MAX_DEPTH}")
            self.out.broken.append(prefix)
            return
        tree = self.parse(file, place)
        given = self.fields.table(self.overridden(full, table.get("params"), place), "params")
        wired = self.wiring(table.get("inputs"), scope, inputs)
        inner = _Scope(
            file=file,
            shown=self.shown(file),
            prefix=f"{full}/",
            key=prefix,
            given={key: e.value for key, e in given.entries.items()} if given else {},
            bindings=wired,
            use=place,
            process=self.label(table.get("process"), "process") or scope.process,
            machine=self.label(table.get("machine"), "machine") or scope.machine,
            stack=(*scope.stack, file),
        )
        body = self.top(tree, inner) if tree is not None else None
        if body is None:
            self.out.broken.append(prefix)
        else:
            self.body(body, inner)

    def operator_parameters(self, full: str, cls: type[Operator], table: Table, place: Place) -> dict[str, Any]:
        entry = table.entries.get("params")
        tree = self.overridden(full, entry.value if entry else None, place)
        given = self.fields.table(tree, "params") or Table({}, place)
        known = {key: e for key, e in given.entries.items() if not unknown(e.value)}
        reported = given.entries.keys() - known.keys()
        try:
            values = cls.spec.parameters(**plain(Table(known, given.place)))
        except pydantic.ValidationError as error:
            for fault in error.errors():
                if fault["loc"][:1] not in {(name,) for name in reported}:
                    self.parameter_fault(full, cls, fault, given, entry.key.place if entry else place)
            return {}
        except Exception as error:  # a parameter type's own validator may raise anything
            self.problems.add(given.place, f"{full}: {type(error).__name__}: {error}")
            return {}
        return values.model_dump(mode="json")

    def parameter_fault(self, full: str, cls: type[Operator], fault: Any, given: Table, place: Place) -> None:
        fields = cls.spec.parameters.model_fields
        path = tuple(fault["loc"])
        name = ".".join(map(str, path))
        match fault["type"]:
            case "extra_forbidden" if len(path) == 1 and name in given.entries:
                hint = did_you_mean(name, fields, f"parameters of {cls.__name__}")
                key = given.entries[name].key.place
                self.problems.add(key, f"{full}: {cls.__name__} has no parameter {name!r}", hint)
            case "missing" if len(path) == 1:
                doc = fields[name].description or ""
                self.problems.add(place, f"{full}: parameter {name!r} must be given", f"{name}: {doc}")
            case _:
                value = at(given, path)
                message = str(fault["msg"]).removeprefix("Value error, ")
                message = message[:1].lower() + message[1:]
                hint = f"{path[0]}: {fields[str(path[0])].description}" if path and str(path[0]) in fields else ""
                if fault["type"] == "string_type" and isinstance(value, Leaf) and not isinstance(value.value, str):
                    hint = f"write '{value.raw}' in quotes"
                elif fault["type"] in ("literal_error", "enum") and isinstance(value, Leaf):
                    near = nearest(str(value.value), re.findall(r"'([^']*)'", message))
                    hint = f"did you mean {near!r}?" if near else hint
                said = value.raw if isinstance(value, Leaf) else describe(value)
                self.problems.add(value.place, f"{full}: parameter {name!r}: {message}, got {said}", hint)

    def label(self, tree: Tree | None, what: str) -> Leaf | None:
        word = self.fields.text(tree, what)
        if word is None or tree is None:
            return None
        if fault := name_fault(word):
            self.problems.add(tree.place, f"{what} label {fault}", NAME_RULE)
            return None
        return Leaf(word, tree.place, word)

    # -- inputs --------------------------------------------------------------------------------------------------

    def wiring(
        self, tree: Tree | None, scope: _Scope, inputs: Mapping[str, GraphInput]
    ) -> dict[str, tuple[Place, list[Pattern]]]:
        """Input port → (place of its key, expressions)."""
        table = self.fields.table(tree, "inputs")
        wired = {}
        for port, entry in (table.entries if table else {}).items():
            patterns: list[Pattern] = []
            if isinstance(entry.value, Items) and not entry.value.items:
                self.fields.problems.add(entry.value.place, f"input {port!r} lists no stream", "leave the input out")
            for leaf in self.fields.texts(entry.value, f"input {port!r}"):
                if leaf.value in inputs:
                    bound = inputs[leaf.value].patterns
                    patterns += [Pattern(p.text, p.key, p.place, p.scope, p.via or leaf.place) for p in bound]
                elif (pattern := self.pattern(leaf, scope, inputs)) is not None:
                    patterns.append(pattern)
            wired[port] = (entry.key.place, patterns)
        return wired

    def pattern(self, leaf: Leaf, scope: _Scope, inputs: Mapping[str, GraphInput] | None = None) -> Pattern | None:
        text = leaf.value
        absolute = text.startswith("/")
        if fault := key_fault(text[1:] if absolute else text):
            self.problems.add(leaf.place, f"{text!r} is no key expression: {fault}")
            return None
        if not absolute and "/" not in text and not has_wildcard(text) and inputs:
            hint = did_you_mean(text, inputs, "inputs of this graph")
            self.problems.add(leaf.place, f"{text!r} is neither an input of this graph nor 'operator/port'", hint)
            return None
        key = canonical(text[1:] if absolute else f"{scope.key}/{text}")
        return Pattern(text, key, leaf.place, scope.key)

    # -- namespace, names, settings ------------------------------------------------------------------------------

    def name(self, tree: Tree | None, what: str) -> str | None:
        word = self.fields.text(tree, what)
        if word is None or tree is None:
            return None
        if fault := name_fault(word):
            self.problems.add(tree.place, f"{what} name {fault}", NAME_RULE)
            return None
        return word

    def namespace(self, tree: Tree | None) -> str | None:
        word = self.fields.text(tree, "namespace")
        if word is None or tree is None:
            return None
        for part in word.split("/"):
            if fault := name_fault(part):
                hint = f"names joined by '/', such as robot1 or site/robot1; {NAME_RULE}"
                self.problems.add(tree.place, f"namespace {word!r}: {fault}", hint)
                return None
        return word

    def overridden(self, owner: str, params: Tree | None, place: Place) -> Tree | None:
        """`params` of an operator or nested graph with the `--set` words for it put in."""
        for setting in self.settings:
            if setting.owner != owner:
                continue
            setting.used = True
            if params is None or (isinstance(params, Leaf) and params.value is None):
                params = Table({}, place)
            if isinstance(params, Table):
                params = put(params, setting.path, setting)
        return params

    def unused_settings(self) -> None:
        known_params = self.fields.table(self.parsed_root_params(), "params")
        for setting in self.settings:
            if setting.used:
                continue
            if not setting.owner:
                names = list(known_params.entries) if known_params else []
                hint = did_you_mean(setting.path[0], names, "graph parameters")
                self.problems.add(setting.place, f"the graph has no parameter {setting.path[0]!r}", hint)
            elif not self.is_broken(setting.owner):
                hint = did_you_mean(setting.owner, sorted(self.out.names), "operators")
                self.problems.add(setting.place, f"the graph has no operator {setting.owner!r}", hint)

    def is_broken(self, name: str) -> bool:
        """True for an operator that could not be had, or one inside a nested graph that could not."""
        key = f"{self.out.namespace}/{name}/"
        return any(key.startswith(f"{prefix}/") for prefix in self.out.broken)

    def parsed_root_params(self) -> Tree | None:
        root = next(iter(self.parsed.values()))
        params = root.get("params") if isinstance(root, Table) else None
        return params if isinstance(params, Table) else None
