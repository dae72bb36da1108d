"""Every cause is found by its effect, alone and beside another, within the re-runs that are allowed."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import pytest

from dataflow.causes.ladder import MOST, Findings, InterventionSearch
from dataflow.causes.rerun import Rerun, RerunSettings
from dataflow.causes.sources import (
    ADDRESSES,
    CHANCE,
    COMPILED,
    ENTROPY,
    FILE,
    FOLDER,
    HASHES,
    HEAP,
    IDENTITY,
    LOCALE,
    MODULE,
    MONOTONIC,
    MOVED,
    NUMPY,
    RANDOM,
    THREADS,
    UUID,
    VARIABLE,
    WALL,
    WORKING,
    named,
)
from dataflow.causes.traps import Site
from dataflow.supervision.core.report import RunFailed

UNSEEN = (HEAP, ADDRESSES, COMPILED)
"""Sources that no log shows; what is asked for addresses is known where they are fixed."""
GAIN, TABLE = named(VARIABLE, "GAIN"), named(FILE, "table.csv")
MODELS = named(FOLDER, "models")
SITE = Site("own.py", 1, "process", "call")


@dataclass(slots=True)
class Operator:
    """Makes something else whenever one of its `causes` is not fixed, or is changed; `reads` are logged."""

    causes: Collection[str]
    reads: Collection[str] = ()
    differs: bool = False
    settings: list[RerunSettings] = field(default_factory=list)

    def fire(self, setting: RerunSettings) -> Rerun:
        self.settings.append(setting)
        chance = [s for s in self.causes if s in CHANCE and s not in setting.fixed]
        run = len(self.settings) if self.differs or (chance and not setting.varied) else 0
        made = (f"{run} {sorted(setting.varied.intersection(self.causes))} {sorted(chance)}",)
        read = {s for s in (*self.causes, *self.reads) if s not in (*UNSEEN, HASHES, MODULE)}
        given = setting.fixed.intersection(self.causes)
        return Rerun(made, sites=tuple((source, SITE, 3) for source in sorted(read)), threads=0, given=given)


@dataclass(slots=True)
class Repeating(Operator):
    """Repeats, and depends on what no recording holds."""

    def fire(self, setting: RerunSettings) -> Rerun:
        found, moved = Operator.fire(self, setting), setting.varied.intersection(self.causes)
        return Rerun((str(sorted(moved)),), sites=found.sites, given=moved)


def climbed(operator: Operator, repeats: bool | None = False, left_out: tuple[str, ...] = ()) -> Findings:
    found = InterventionSearch(operator.fire, left_out).climb(repeats)
    assert found.reruns == len(operator.settings) <= MOST
    return found


@pytest.mark.parametrize("cause", CHANCE)
def test_a_source_of_chance_is_named(cause: str) -> None:
    found = climbed(Operator({cause}, reads={WALL, MONOTONIC, RANDOM}))

    assert found.causes == [cause]
    assert found.settled
    assert not found.repeats


@pytest.mark.parametrize("pair", list(itertools.combinations(CHANCE, 2)))
def test_two_at_once_are_both_named(pair: tuple[str, str]) -> None:
    found = climbed(Operator(set(pair)))

    assert set(found.causes) == set(pair)


def test_sources_that_are_read_without_effect_are_cleared() -> None:
    found = climbed(Operator({UUID}, reads={WALL, MONOTONIC, NUMPY, ENTROPY}))

    assert found.causes == [UUID]
    assert {WALL, MONOTONIC, NUMPY, ENTROPY} <= set(found.cleared)


@pytest.mark.parametrize("repeats", [True, False, None])
def test_a_sound_operator_has_no_cause(repeats: bool | None) -> None:
    found = climbed(Operator((), reads={WALL, MONOTONIC, RANDOM, NUMPY, UUID, ENTROPY, GAIN, TABLE}), repeats)

    assert not found.causes
    assert not found.open


@pytest.mark.parametrize("cause", [IDENTITY, WALL, MONOTONIC])
def test_a_source_that_compiled_code_asks_is_tried_though_no_log_shows_it(cause: str) -> None:
    """`sorted(things, key=id)` calls `id` past the interpreter."""
    operator = Operator({cause})

    found = InterventionSearch(lambda setting: replace(operator.fire(setting), sites=())).climb(repeats=False)

    assert found.causes == [cause]
    assert found.reruns <= MOST


def test_more_causes_than_there_are_re_runs_for_stay_open_and_are_not_guessed() -> None:
    causes = {HEAP, ADDRESSES, COMPILED, WALL, UUID, NUMPY}

    found = climbed(Operator(causes))

    assert set(found.causes) < causes
    assert causes == set(found.causes).union(*found.open)


def test_difference_with_all_sources_fixed_has_no_known_cause() -> None:
    found = climbed(Operator({WALL}, differs=True))

    assert found.settled is False
    assert not found.causes


def test_sources_that_cannot_be_fixed_here_are_not_tried() -> None:
    found = climbed(Operator({UUID}), left_out=(COMPILED, ADDRESSES))

    assert found.causes == [UUID]
    assert not {COMPILED, ADDRESSES} & {*found.cleared, *found.causes}


@pytest.mark.parametrize("cause", [HASHES, HEAP, MODULE, THREADS, *MOVED, LOCALE, GAIN, TABLE, MODELS, WORKING])
def test_source_on_which_a_repeating_operator_depends_is_named(cause: str) -> None:
    found = climbed(Repeating({cause}, reads={WALL, GAIN}), repeats=True)

    assert found.repeats
    assert found.causes == [cause]


@pytest.mark.parametrize("cause", [MONOTONIC, ADDRESSES])
def test_cause_with_agreeing_runs_is_found_beside_other_causes(cause: str) -> None:
    """The difference of two readings of a clock, rounded to 10 ms, is 0 in two quiet runs."""
    operator = Repeating({cause, ENTROPY, HEAP}, reads={WALL, GAIN})

    found = InterventionSearch(lambda setting: replace(operator.fire(setting), sites=())).climb(repeats=True)

    assert set(found.causes) == {cause, ENTROPY, HEAP}
    assert found.reruns <= MOST


@pytest.mark.parametrize("repeats", [True, False])
def test_a_source_that_is_left_free_is_changed_as_well_since_real_runs_may_agree(repeats: bool) -> None:
    operator = Operator({MONOTONIC}) if not repeats else Repeating({MONOTONIC})

    climbed(operator, repeats)

    assert any(MONOTONIC in setting.varied and MONOTONIC not in setting.fixed for setting in operator.settings)


def test_threads_that_repeat_among_themselves_are_no_cause() -> None:
    """Sums of four threads may differ from those of one, and be the same each time."""

    def fire(setting: RerunSettings) -> Rerun:
        made = (f"{THREADS in setting.fixed} {0 if UUID in setting.fixed else object()}",)
        return Rerun(made, sites=((UUID, SITE, 1),), threads=4)

    found = InterventionSearch(fire).climb(repeats=False)

    assert found.causes == [UUID]


def test_process_death_by_an_unfixed_source_reveals_the_cause() -> None:
    operator = Operator(())

    def fire(setting: RerunSettings) -> Rerun:
        if setting.fixed and HEAP not in setting.fixed:
            raise RunFailed("operator 'x' was killed by SIGSEGV")
        return operator.fire(setting)

    assert InterventionSearch(fire).climb(repeats=False).causes == [HEAP]
