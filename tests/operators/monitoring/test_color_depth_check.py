"""A colour camera that is turned against its extrinsic is named by the edges; one that is not, is not."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest

from dataflow import Played, play
from dataflow.messages import DepthImage, Image, Transforms
from dataflow.messages.diagnostics import Level
from operators.monitoring import ColorDepthCheck
from operators.monitoring.edge_alignment import EdgeAlignment, rims
from tests.operators.monitoring.rooms import K, extrinsics, info, views


@cache
def pairs() -> tuple[list[Image], list[DepthImage]]:
    seen = list(views(16))
    return [image for _, image, _ in seen], [depth for depth, _, _ in seen]


def checked(known: Transforms) -> Played:
    images, depths = pairs()
    infos = {"image_info": [info("color")], "depth_info": [info("depth")], "extrinsics": [known]}
    return play(ColorDepthCheck(period="200ms"), {"image": images, "depth": depths} | infos, static=list(infos))


def warnings(played: Played) -> list[str]:
    return [s.messages[0] for s in played["status"] if s.levels[0] == Level.WARN]


def test_cameras_that_fit_raise_no_alarm() -> None:
    played = checked(extrinsics())
    assert len(played["status"]) == 16
    assert warnings(played) == []


@pytest.mark.parametrize(
    ("axis", "angle", "right", "below"), [("y", 3.0, 3, 0), ("y", -3.0, -3, 0), ("x", 3.0, 0, -3), ("x", -3.0, 0, 3)]
)
def test_a_turned_camera_is_said_with_the_angle(axis: str, angle: float, right: float, below: float) -> None:
    said = warnings(checked(extrinsics(color=(axis, angle))))
    assert len(said) >= 5
    told = re.search(r"lies (\S+)° right and (\S+)° below", said[-1])
    assert told is not None
    assert [float(each) for each in told.groups()] == pytest.approx([right, below], abs=0.6)


def test_the_shift_is_that_of_the_image() -> None:
    alignment = EdgeAlignment()
    for image, depth in zip(*pairs(), strict=True):
        alignment.add(np.roll(image.data, (8, -12), axis=(0, 1)), K, rims(depth.data, K))
    whole = alignment.shifts()[0]
    assert [whole.x, whole.y] == pytest.approx([-6, 4], abs=1)
    assert whole.off(3)


def test_images_without_edges_say_nothing() -> None:
    alignment = EdgeAlignment()
    _, depths = pairs()
    alignment.add(np.full((240, 320, 3), 90, np.uint8), K, rims(depths[0].data, K))
    assert alignment.shifts() == []
    alignment.add(pairs()[0][0].data, K, rims(np.zeros((240, 320), np.float32), K))
    assert not any(shift.off(3) for shift in alignment.shifts())


def test_rims_are_pixels_in_front_of_something() -> None:
    depth = np.full((40, 40), 3.0, np.float32)
    depth[10:20, 10:20] = 1.0
    depth[0, :] = 0.0
    depth[30:, :], depth[:, 30:] = np.inf, np.nan
    assert set(rims(depth, K)[:, 2]) == {1.0}


def test_a_restored_check_goes_on_as_the_first_would_have() -> None:
    images, depths = pairs()
    first, second = ColorDepthCheck(), ColorDepthCheck()
    first.setup()
    second.setup()
    given = (info("color"), info("depth"), extrinsics(color=("y", 3.0)))
    for k in range(0, 6, 2):
        first.process(images[k], depths[k], *given)
    second.restore(first.snapshot())
    told = [each.process(images[6], depths[6], *given) for each in (first, second)]
    assert told[0] is not None
    assert told[1] is not None
    assert told[0].digest() == told[1].digest()
