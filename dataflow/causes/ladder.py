"""The ladder of re-runs that finds the causes of a difference, in at most `MOST` of them.

An operator that does not repeat: with all sources of chance fixed it repeats, and with a cause left free it does not
make the same. One that repeats, and not what was recorded: with a cause changed it makes something else, also where two
runs agree by chance, such as by a clock that is rounded to 10 ms. Sources are tried in groups: a group without effect
is cleared by one re-run, one with an effect is halved. So several causes are found, each by its effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from dataflow.causes.rerun import Rerun, RerunSettings
from dataflow.causes.sources import (
    CHANCE,
    COMPILED,
    FILE,
    FOLDER,
    HASHES,
    HEAP,
    LOCALE,
    MODULE,
    MOVED,
    THREADS,
    VARIABLE,
    WORKING,
    kind_of,
)
from dataflow.supervision.core.report import RunFailed

MOST = 8
"""Re-runs of one operator."""

_MOVED = frozenset({HEAP, COMPILED, *MOVED})
"""Sources that are changed rather than left free: they might give the same by chance."""

Fire = Callable[[RerunSettings], Rerun]


@dataclass(slots=True)
class Findings:
    """The outcome of the ladder: `causes`, shown by their effect; `cleared` sources, which have none; `open` groups, of
    which one has an effect, but re-runs were used up. `first` is the re-run that logged; `repeats`: whether the
    operator repeats at all; `settled`: whether it does where all sources of chance are fixed (None: not tried).
    `left`: what it leaves in modules and classes."""

    first: Rerun
    repeats: bool
    settled: bool | None = None
    reruns: int = 0
    causes: list[str] = field(default_factory=list)
    cleared: list[str] = field(default_factory=list)
    open: list[tuple[str, ...]] = field(default_factory=list)
    left: tuple[str, ...] = ()

    @property
    def hopeless(self) -> bool:
        """True where it does not repeat with all sources fixed: no effect of one can be seen."""
        return self.settled is False


class InterventionSearch:
    """Climbs with `fire`, which re-runs the operator; `left_out` are sources that cannot be fixed here."""

    def __init__(self, fire: Fire, left_out: Sequence[str] = (), most: int = MOST) -> None:
        self._fire_once, self._left_out, self._most = fire, left_out, most
        self._fired = 0

    def climb(self, repeats: bool | None) -> Findings:
        """Finds causes. `repeats`: whether verification found that it differs alike each time; None if not known."""
        first = self._fire(RerunSettings(log=True))
        base = first if repeats is False else self._fire(RerunSettings())
        found = Findings(first, repeats=repeats is not False and first.same(base))
        if found.repeats:
            self._find_varied(found, base)
        else:
            self._find_freed(found)
        found.reruns = self._fired
        return found

    def _fire(self, setting: RerunSettings) -> Rerun:
        if self._fired == self._most:
            raise _SpentError
        self._fired += 1
        return self._fire_once(setting)

    def _tried(self, setting: RerunSettings) -> Rerun:
        """Re-runs; where the process dies of what was changed, that is what came out."""
        try:
            return self._fire(setting)
        except RunFailed as failure:
            if failure.interrupted:
                raise
            return Rerun((f"failed: {failure}",))

    def _find_freed(self, found: Findings) -> None:
        fixed = frozenset(CHANCE).difference(self._left_out)
        base = self._fire(RerunSettings(fixed))
        seen = {source for source, _, _ in found.first.sites} | ({THREADS} if found.first.threads else set())
        seen |= base.given  # also to compiled code, past the log: `sorted(things, key=id)`
        unseen = [s for s in (HEAP, COMPILED) if s in fixed and s not in seen]
        trapped = [s for s in CHANCE if s in fixed & seen]

        def effect(group: Sequence[str]) -> Rerun | None:
            made = self._tried(RerunSettings(fixed.difference(group), _MOVED.intersection(group)))
            if made.same(base):
                found.settled = True
                return None
            return made

        def confirmed(source: str, made: Rerun) -> bool:
            """Nothing is a cause as long as the operator does not repeat with all sources fixed. Several threads may
            make the same each time, and yet not the same as one: that is no cause, either."""
            if found.settled is None:
                found.settled = self._fire(RerunSettings(fixed)).same(base)
            return bool(found.settled) and (
                source != THREADS or not self._fire(RerunSettings(fixed - {THREADS})).same(made)
            )

        self._search(found, [unseen, *([s] for s in trapped)], effect, confirmed)

    def _find_varied(self, found: Findings, base: Rerun) -> None:
        seen = dict.fromkeys(source for source, _, _ in found.first.sites)
        outside = [s for s in seen if kind_of(s) in (VARIABLE, FILE, FOLDER, WORKING, LOCALE)]
        chance = [THREADS, *(s for s in CHANCE if s in MOVED)]
        moved = self._tried(RerunSettings(varied=frozenset(chance)))
        asked = [s for s in chance if s in seen or s in moved.given]
        known = {tuple(asked): moved}  # those that are not asked for have no effect

        def effect(group: Sequence[str]) -> Rerun | None:
            made = known.get(tuple(group)) or self._tried(RerunSettings(varied=frozenset(group)))
            found.left = found.left or made.left
            return None if made.same(base) else made

        found.cleared += [s for s in CHANCE if s in seen and s not in chance and s != HEAP]  # free in both
        groups = [asked, [HASHES, HEAP, MODULE], *([s] for s in outside)]
        self._search(found, groups, effect, lambda source, made: True)

    def _search(
        self,
        found: Findings,
        groups: list[list[str]],
        effect: Callable[[Sequence[str]], Rerun | None],
        confirmed: Callable[[str, Rerun], bool],
    ) -> None:
        left = [_Group(group) for group in groups if group]
        while left and not found.hopeless:
            room = self._most - self._fired
            if len(left) > room > 0 and not any(group.rest for group in left[room - 1 :]):  # several at once
                left[room - 1 :] = [_Group([source for group in left[room - 1 :] for source in group.sources])]
            sources, known = left[0].sources, left[0].known(found.cleared)
            try:
                made = None if known and (len(sources) > 1 or sources != [THREADS]) else effect(sources)
                if made is None and not known:
                    found.cleared += sources
                elif len(sources) > 1:
                    half = len(sources) // 2
                    left[1:1] = [_Group(sources[:half]), _Group(sources[half:], tuple(sources[:half]))]
                elif made is None or confirmed(sources[0], made):
                    found.causes.append(sources[0])
                elif not found.hopeless:
                    found.cleared.append(sources[0])
            except _SpentError:
                found.open = [tuple(group.sources) for group in left]
                return
            del left[0]


@dataclass(frozen=True, slots=True)
class _Group:
    """Sources to be tried at once; `rest`: those without which they have the effect of a group that was halved."""

    sources: list[str]
    rest: tuple[str, ...] = ()

    def known(self, cleared: Sequence[str]) -> bool:
        """Returns whether the group must have an effect, since its other half has none."""
        return bool(self.rest) and set(self.rest) <= set(cleared)


class _SpentError(Exception):
    """All re-runs are used up."""
