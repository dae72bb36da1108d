"""A robot that stands and watches people who choose: where it stands, and what it then sees."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages import Activity, Detections2D, Odometry
from operators.simulator.lookout import watching
from operators.simulator.robot import SimulatedRobot
from operators.simulator.settings import ColorCamera
from operators.simulator.worlds.make import make_world


def robot(world: str, seed: int, people: int = 3, **params: object) -> SimulatedRobot:
    made = SimulatedRobot(
        world=world,
        seed=seed,
        people=people,
        route="watch",
        duration="16s",
        color_camera={"rate": 1, "width": 160, "height": 120},
        depth_camera={"rate": 0},
        truth={"poses": 1, "relations": 0, "activities": 1, "min_pixels": 4},
        **params,
    )
    made.setup()
    return made


@pytest.mark.long
@pytest.mark.parametrize(("world", "seed"), [("office", 801), ("corridor", 802), ("table_top", 803), ("yard", 804)])
def test_choosing_person_and_most_candidates_are_in_view(world: str, seed: int) -> None:
    """The head too, but at the table, where the camera looks down by 18 degrees and the round is near."""
    made = robot(world, seed)
    chooser, share, tops, chosen, seen = -1, [], [], set(), set()
    for messages in made.stream():
        activities, objects = messages["activities"], messages["objects"]
        assert isinstance(activities, Activity)
        assert isinstance(objects, Detections2D)
        assert objects.ids is not None
        assert objects.visible is not None
        shown = dict(zip(objects.ids.tolist(), objects.visible.tolist(), strict=True))
        if chooser < 0:
            things = {p.relation.object: p.relation.subject for p in made._stage.world.placements
                      if p.relation.predicate in ("reaching_for", "sitting_on")}  # fmt: skip
            of = list(things.values())
            chooser = max(set(of), key=of.count)
            chosen = {thing for thing, person in things.items() if person == chooser}
        share.append(shown.get(chooser, 0.0))
        tops += objects.boxes[objects.ids == chooser, 1].tolist()
        seen |= {i for i in chosen if shown.get(i, 0.0) > 0.3}
    assert np.mean([s > 0.3 for s in share]) > 0.8
    assert world == "table_top" or np.mean([top > 0.5 for top in tops]) > 0.9
    assert len(seen) >= 5, f"of {sorted(chosen)} only {sorted(seen)}"


@pytest.mark.long
def test_it_stands_still_on_its_round() -> None:
    made = robot("office", 801)
    round_path = make_world("office", 801, speed=0.5, hold=0.0, movers=True, people=3).path
    poses = [m["true_base"] for m in made.stream()]
    assert all(isinstance(p, Odometry) for p in poses)
    places = np.array([p.matrix()[:2, 3] for p in poses if isinstance(p, Odometry)])
    assert np.ptp(places, axis=0).max() < 1e-9
    assert np.hypot(*(round_path.outline() - places[0]).T).min() < 0.05
    assert all(not np.any(p.linear) and not np.any(p.angular) for p in poses if isinstance(p, Odometry))


@pytest.mark.long
def test_the_heading_is_that_of_the_camera_whatever_its_mount() -> None:
    world = make_world("office", 801, speed=0.5, hold=0.0, movers=True, people=3)
    ahead = watching(world, ColorCamera(mount=(0, 0, 1, 0, 0.1, 0))).path.at([0.0])
    aside = watching(world, ColorCamera(mount=(0, 0, 1, 0, 0.1, 1.0))).path.at([0.0])
    np.testing.assert_allclose(ahead.position, aside.position)
    turned = float(ahead.yaw[0] - aside.yaw[0])
    assert (turned - 1.0 + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-3)


@pytest.mark.long
def test_world_without_choosers_is_refused_with_a_hint() -> None:
    with pytest.raises(ValueError, match=r"no person here chooses .* give people: 3 or 4"):
        robot("office", 801, people=2)


@pytest.mark.long
def test_a_robot_that_stands_cannot_be_carried_along_its_path() -> None:
    with pytest.raises(ValueError, match="no path to be carried along"):
        robot("office", 801, kidnaps=[{"at": 3, "ahead": 0.2}])
