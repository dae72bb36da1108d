"""Streams of a graph: found by key expression, and named in messages as a file would name them."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.graph.drafts import Expansion, OperatorDraft, Pattern
from dataflow.graph.keys import has_wildcard, matching, may_reach
from dataflow.graph.model import Stream
from dataflow.graph.problems import Place, Problems, nearest
from dataflow.messages.base import Message, is_built_in
from dataflow.messages.declaration import Declaration
from dataflow.operator import InputPort


class Streams:
    """The streams that the operators of an expansion make, with their types and the names they are exported by."""

    def __init__(self, expansion: Expansion, problems: Problems) -> None:
        self.expansion, self.problems = expansion, problems
        self.streams: dict[str, Stream] = {}
        self.types: dict[str, tuple[type[Message], ...]] = {}
        self.own_types: dict[str, Declaration] = {}
        self.aliases: dict[str, str] = {}
        for draft in expansion.drafts:
            for port in draft.cls.spec.outputs.values():
                name = f"{expansion.namespace}/{draft.name}/{port.name}"
                schemas = tuple(t.SCHEMA or "Message" for t in port.types)
                self.streams[name] = Stream(name, draft.name, port.name, schemas, port.static, port.lag)
                self.types[name] = port.types
                self.own_types |= {t.SCHEMA: Declaration.of(t) for t in port.types if not is_built_in(t)}

    def settle_aliases(self) -> None:
        """Exported outputs, inner graphs first, so that an outer graph may export an inner one's export."""
        waiting = list(self.expansion.aliases)
        while waiting:
            later = []
            for alias in waiting:
                pattern = alias.pattern
                target = self.aliases.get(pattern.key, pattern.key)
                if target in self.streams:
                    self.aliases[alias.key] = target
                else:
                    later.append(alias)
            if len(later) == len(waiting):
                for alias in later:
                    self.no_match(alias.pattern, f"output {alias.key.rpartition('/')[2]!r}", None)
                    self.expansion.broken.append(alias.key)
                return
            waiting = later

    def match(self, pattern: Pattern) -> list[str]:
        """The streams that an expression reaches, exported names included, sorted."""
        found = set(matching(pattern.key, self.streams))
        found |= {self.aliases[alias] for alias in matching(pattern.key, self.aliases)}
        return sorted(found)

    def no_match(self, pattern: Pattern, what: str, port: InputPort | None) -> None:
        if any(may_reach(pattern.key, prefix) for prefix in self.expansion.broken):
            return
        written = pattern.text
        names = [*self.streams, *self.aliases]
        hint = ""
        below = [self.short(n, pattern.scope) for n in names if n.startswith(pattern.key + "/")]
        if has_wildcard(pattern.key):
            hint = self.carriers(port.types, pattern.scope) if port else ""
        elif below:
            hint = f"name one of its ports: {', '.join(below)}"
        else:
            operator = pattern.key.rpartition("/")[0]
            ports = [self.short(n, pattern.scope) for n in names if n.rpartition("/")[0] == operator]
            near = self.nearest_stream(pattern, ports) or self.nearest_stream(
                pattern, [self.short(n, pattern.scope) for n in names]
            )
            if near is not None:
                hint = f"did you mean {near!r}?"
            elif ports:
                hint = f"its ports: {', '.join(ports)}"
            else:
                hint = f"streams here: {', '.join(self.short(n, pattern.scope) for n in self.streams) or 'none'}"
        missing = "matches no stream" if has_wildcard(pattern.key) else "is no stream of this graph"
        self.problems.add(pattern.place, f"{what}: {written!r} {missing}", hint, self.via(pattern))

    def nearest_stream(self, pattern: Pattern, names: list[str]) -> str | None:
        """By whole key, or else by the port alone when every candidate is of the same operator."""
        near = nearest(pattern.text, names)
        if near is None and names and len({n.rpartition("/")[0] for n in names}) == 1:
            port = nearest(pattern.text.rpartition("/")[2], [n.rpartition("/")[2] for n in names])
            near = next((n for n in names if port is not None and n.endswith(f"/{port}")), None)
        return near

    def told(self, stream: str, scope: str) -> str:
        made = self.streams[stream]
        draft = next(d for d in self.expansion.drafts if d.name == made.node)
        short = self.short(stream, scope)
        return f"{short!r} ({draft.cls.spec.name}.{made.port}) carries {' | '.join(made.types)}"

    def short(self, stream: str, scope: str) -> str:
        """The stream as it is written in the file at hand."""
        if stream.startswith(f"{scope}/"):
            return stream.removeprefix(f"{scope}/")
        return f"/{stream}"

    def scope_of(self, draft: OperatorDraft) -> str:
        parent = draft.name.rpartition("/")[0]
        return f"{self.expansion.namespace}/{parent}" if parent else self.expansion.namespace

    def carriers(self, wanted: Iterable[type[Message]], scope: str) -> str:
        """A hint that lists the streams of a type."""
        types = tuple(wanted)
        names = [n for n, produced in self.types.items() if all(issubclass(p, types) for p in produced)]
        if not names:
            return ""
        word = " | ".join(t.SCHEMA or "Message" for t in types)
        return f"streams of {word}: {', '.join(self.short(n, scope) for n in names)}"

    def via(self, pattern: Pattern) -> list[tuple[Place, str]]:
        return [] if pattern.via is None else [(pattern.via, "used here, inside the nested graph")]
