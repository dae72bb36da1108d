"""Persons who choose among drinks and seats: what they are said to want is what they get."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest

from operators.simulator.people.body import varied_body
from operators.simulator.people.movers import CarriedObject
from operators.simulator.people.persons import Person
from operators.simulator.scene import Thing, World
from operators.simulator.things.furnishing import FLOOR
from operators.simulator.worlds.make import NAMES, make_world

OFFICE_AND_LONG = [NAMES[0], *(pytest.param(name, marks=pytest.mark.long) for name in NAMES[1:])]


@functools.lru_cache
def world(name: str, seed: int, people: int = 4) -> World:
    return make_world(name, seed, speed=0.5, hold=0.0, movers=True, people=people)


def choosers(here: World) -> list[Thing]:
    return [
        thing
        for thing in here.objects()
        if isinstance(thing.mover, Person) and len({act.goal for act in thing.mover.timeline.acts}) > 4
    ]


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_there_are_as_many_persons_as_are_asked_for(name: str) -> None:
    for people in (2, 3, 4):
        here = world(name, 0, people)
        assert sum(thing.label == "person" for thing in here.objects()) == people
        assert len(choosers(here)) == people - 2


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_choosing_person_has_six_candidates_and_reaches_its_goals(name: str, seed: int) -> None:
    here = world(name, seed)
    for person in choosers(here):
        timeline = person.mover.timeline
        goals = {act.goal for act in timeline.acts}
        assert len(goals) == 6
        reached = set()
        for t in np.arange(0, timeline.period, 0.3):
            (doing,) = (d for d in here.doings(t) if d.thing == person.id)
            relations = [r for r in here.relations(t) if r.subject == person.id]
            found = re.fullmatch(r"(?:sit down on|drink from) (\w+) (\d+)", doing.goal)
            assert found is not None
            wanted = int(found[2])
            assert here.thing(wanted).label == found[1]
            for relation in relations:
                if relation.predicate in ("holding", "reaching_for", "sitting_on"):
                    assert relation.object == wanted
                    reached.add(doing.goal)
            words = {r.predicate for r in relations}
            assert ("sitting_on" in words) == (doing.activity == "sitting")
            assert ("holding" in words) == (doing.activity == "drinking")
            assert ("reaching_for" in words) == (doing.activity == "reaching")
            assert ("on" in words) != ("sitting_on" in words)
        assert reached == goals


@pytest.mark.parametrize("name", OFFICE_AND_LONG)
def test_a_goal_is_known_before_it_is_reached(name: str) -> None:
    """From the choice until the hand or the pelvis moves there are seconds in which to infer it."""
    for person in choosers(world(name, 0)):
        acts, leads, lead = person.mover.timeline.acts, [], 0.0
        for act in acts:
            lead = lead + act.seconds if act.activity in ("standing", "walking") else 0.0
            if act.activity == "walking":
                leads.append(lead)
        assert min(leads) > 2


@pytest.mark.parametrize("name", OFFICE_AND_LONG)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_hand_reaches_the_grasp_point(name: str, seed: int) -> None:
    here = world(name, seed)
    for mover in (thing.mover for thing in here.objects() if isinstance(thing.mover, Person)):
        before = -mover.timeline.phase
        for act in mover.timeline.acts:
            if act.activity == "drinking" and act.lift == (0.0, 1.0):
                assert act.grasp is not None
                assert np.linalg.norm(mover.grip(before + 1e-3) - act.grasp) < 0.03
                still, lifted = (here.thing(act.object).mover.frame(t)[:3, 3] for t in (before, before + 1.3))
                assert np.linalg.norm(still - act.grasp) < 0.12
                assert lifted[2] > still[2] + 0.2
            before += act.seconds


@pytest.mark.parametrize("name", OFFICE_AND_LONG)
def test_carried_object_lies_on_its_table_while_not_held(name: str) -> None:
    here = world(name, 0)
    for thing in (t for t in here.objects() if isinstance(t.mover, CarriedObject)):
        for t in np.arange(0, 60, 1.3):
            held = any(r.predicate == "holding" and r.object == thing.id for r in here.relations(t))
            lies = [r.object for r in here.relations(t) if r.predicate == "on" and r.subject == thing.id]
            assert held != bool(lies)
            assert FLOOR not in lies
            if lies:
                table = here.thing(lies[0]).vertices(t)
                assert thing.vertices(t)[:, 2].min() == pytest.approx(table[:, 2].max(), abs=0.02)


def test_varied_bodies_differ_in_size_and_shape() -> None:
    bodies = [varied_body(np.random.default_rng(seed)) for seed in range(40)]
    assert np.ptp([body.height for body in bodies]) > 0.35
    assert len({tuple(len(part) for part in body.parts) for body in bodies}) >= 6
    assert {len(body.parts) for body in bodies} == {13}
