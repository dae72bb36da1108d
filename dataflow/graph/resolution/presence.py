"""Settles what of a graph is there: optional inputs that are not given, and the operators that do without or go.

An operator that lacks an input it needs is left out, and so is what needs it, up to the nested graph whose input was
not given. Further out a file that names what is not made has a fault: it left the input out itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dataflow.graph.drafts import Absence, Alias, Choice, Expansion, OperatorDraft, Pattern
from dataflow.graph.keys import has_wildcard
from dataflow.graph.problems import Place, Problems


class Presence:
    """Chooses among the ways of every input and takes operators out of the expansion."""

    def __init__(self, expansion: Expansion, problems: Problems) -> None:
        self.expansion, self.problems = expansion, problems
        self.left_out = dict(expansion.left_out)
        self.aliases = {alias.key: alias for alias in expansion.aliases}
        self._open: set[str] = set()
        self._found: dict[int, tuple[Pattern, ...]] = {}

    def settle(self) -> None:
        """Writes the chosen inputs into the drafts; faults go to the problems."""
        out = self.expansion
        while lacking := {d.name: why for d in out.drafts if d.name not in self.left_out and (why := self._lack(d))}:
            self.left_out |= lacking
            self._found.clear()
        kept = [draft for draft in out.drafts if draft.name not in self.left_out]
        for draft in kept:
            self._choose(draft)
        for at, (name, bound) in enumerate(out.graph_inputs):
            scope = name.rpartition("/")[0].rpartition("/")[0]
            for choice in bound.choices:
                if choice.ways:
                    self._allowed(choice, f"{scope}/" if scope else "", f"{name.replace('/', '.')}", bound.place)
            out.graph_inputs[at] = (name, replace(bound, patterns=self._all(bound.choices)))
        self._settle_aliases()
        out.drafts, out.left_out = kept, self.left_out
        out.broken += [f"{out.namespace}/{name}" for name in self.left_out]

    def _settle_aliases(self) -> None:
        out, kept = self.expansion, []
        for alias in out.aliases:
            found = self.found(alias.target)
            if len(found) > 1:
                listed = ", ".join(repr(pattern.text) for pattern in found)
                self.problems.add(
                    alias.place, f"output {alias.key.rpartition('/')[2]!r} must be one stream, not {listed}"
                )
            elif found:
                kept.append(Alias(alias.key, Choice(((found[0],),)), alias.place))
            elif alias.target.ways or alias.target.absence:
                scope = alias.key.removeprefix(f"{out.namespace}/").rpartition("/")[0]
                self._allowed(alias.target, f"{scope}/" if scope else "", "output", alias.place)
                out.broken.append(alias.key)
        out.aliases = kept

    # -- choices -------------------------------------------------------------------------------------------------

    def found(self, choice: Choice) -> tuple[Pattern, ...]:
        """The expressions of the first way of which anything is there."""
        known = self._found.get(id(choice))
        if known is not None:
            return known
        patterns: tuple[Pattern, ...] = ()
        for way in choice.ways:
            patterns = tuple(dict.fromkeys(p for entry in way for p in self._entry(entry)))
            if patterns:
                break
        if choice.via is not None:
            patterns = tuple(p if p.via else replace(p, via=choice.via) for p in patterns)
        self._found[id(choice)] = patterns
        return patterns

    def _entry(self, entry: Pattern | Choice) -> Sequence[Pattern]:
        if isinstance(entry, Choice):
            return self.found(entry)
        return () if self._absent(entry) else (entry,)

    def _all(self, choices: Sequence[Choice]) -> tuple[Pattern, ...]:
        return tuple(dict.fromkeys(p for choice in choices for p in self.found(choice)))

    def why(self, entry: Choice | Pattern) -> tuple[Absence, ...]:
        """The reasons for which nothing of a choice is there; none where it is, or where it has a fault."""
        if isinstance(entry, Pattern):
            return self._absent(entry)
        if entry.absence is not None:
            return (entry.absence,)
        return tuple(dict.fromkeys(why for way in entry.ways for inner in way for why in self.why(inner)))

    def _absent(self, pattern: Pattern) -> tuple[Absence, ...]:
        key = pattern.key
        if has_wildcard(key):
            return ()
        alias = self.aliases.get(key)
        if alias is not None and key not in self._open:
            self._open.add(key)
            try:
                return () if self.found(alias.target) else self.why(alias.target)
            finally:
                self._open.discard(key)
        owner = key.removeprefix(f"{self.expansion.namespace}/").rpartition("/")[0]
        while owner:
            if owner in self.left_out:
                return self.left_out[owner]
            owner = owner.rpartition("/")[0]
        return ()

    # -- operators -----------------------------------------------------------------------------------------------

    def _lack(self, draft: OperatorDraft) -> tuple[Absence, ...]:
        """Why an operator cannot be: an input that it needs is not there, and the file that names it may say so."""
        for name, choices in draft.choices.items():
            port = draft.cls.spec.inputs.get(name)
            if port is None or (port.kind == "sampled" and not port.required) or self._all(choices):
                continue
            reasons = tuple(dict.fromkeys(why for choice in choices for why in self.why(choice)))
            if _known(draft.name, reasons):
                return reasons
        return ()

    def _choose(self, draft: OperatorDraft) -> None:
        for name, choices in draft.choices.items():
            allowed = [
                self._allowed(choice, draft.name, f"{draft.name}.{name}", draft.input_places[name])
                for choice in choices
            ]
            patterns = self._all(choices)
            if patterns or not all(allowed) or not any(self.why(choice) for choice in choices):
                draft.inputs[name] = list(patterns)

    def _allowed(self, choice: Choice, who: str, what: str, place: Place) -> bool:
        """Reports a choice of which nothing is there, though it is not named inside the graph that lacks it."""
        reasons = () if self.found(choice) else self.why(choice)
        if not reasons or _known(who, reasons):
            return True
        pattern = next((p for way in choice.ways for p in way if isinstance(p, Pattern)), None)
        name, at = ("it", place) if pattern is None else (repr(pattern.text), pattern.place)
        self.problems.add(at, f"{what}: {name} is not made: {said(reasons)}", "give that input, or leave this out")
        return False


def said(reasons: Sequence[Absence]) -> str:
    """The reasons for people."""
    return "; ".join(why.reason for why in reasons)


def _known(who: str, reasons: Sequence[Absence]) -> bool:
    return any(who.startswith(why.inside) for why in reasons)
