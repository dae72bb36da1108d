"""A colour camera that is turned against its extrinsic is named by the edges; one that is not, is not."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from repeated import assert_repeats

from dataflow import Played, play
from dataflow.messages import DepthImage, Image, Transforms
from dataflow.messages.diagnostics import Level
from operators.geometry.extrinsics import transform_between
from operators.monitoring import ColorDepthCheck
from operators.monitoring.edge_alignment import EdgeAlignment, rims
from tests.operators.monitoring.rooms import K, extrinsics, info, views, warnings


@cache
def pairs() -> tuple[list[Image], list[DepthImage]]:
    seen = list(views(16))
    return [image for _, image, _ in seen], [depth for depth, _, _ in seen]


def checked(known: Transforms) -> Played:
    images, depths = pairs()
    infos = {"image_info": [info("color")], "depth_info": [info("depth")], "extrinsics": [known]}
    return play(ColorDepthCheck(period="200ms"), {"image": images, "depth": depths} | infos, static=list(infos))


def test_cameras_that_fit_raise_no_alarm() -> None:
    assert [s.levels[0] for s in checked(extrinsics())["status"]] == [Level.OK] * 16
    assert finding(ColorDepthCheck(period="200ms", calibrate=True), extrinsics())[0] == ""


@pytest.mark.parametrize(
    ("axis", "angle", "right", "below"), [("y", 3.0, 3, 0), ("y", -3.0, -3, 0), ("x", 3.0, 0, -3), ("x", -3.0, 0, 3)]
)
def test_a_turned_camera_is_warned_of_with_the_angle(axis: str, angle: float, right: float, below: float) -> None:
    said = warnings(checked(extrinsics(color=(axis, angle))))
    assert len(said) >= 5
    assert figures(r"lies (\S+)° right and (\S+)° below", said[-1]) == pytest.approx([right, below], abs=0.6)


def test_the_shift_is_that_of_the_image() -> None:
    alignment = EdgeAlignment()
    for image, depth in zip(*pairs(), strict=True):
        alignment.add(np.roll(image.data, (8, -12), axis=(0, 1)), K, rims(depth.data, K))
    whole = alignment.shifts()[0]
    assert [whole.x, whole.y] == pytest.approx([-6, 4], abs=1)
    assert whole.off(3)


def test_images_without_edges_give_no_shift() -> None:
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


def test_restored_check_continues_identically() -> None:
    given = (info("color"), info("depth"), extrinsics(color=("y", 3.0)))
    calls = [(image, depth, *given) for image, depth in zip(*pairs(), strict=True)]
    assert_repeats(ColorDepthCheck, calls[:8:2], 3)


def displaced(metres: float) -> Transforms:
    """Returns the extrinsics with a colour camera that is said to be so far to the right of where it is."""
    known = extrinsics()
    places = known.translations.copy()
    places[known.child_frames.index("color")] += known.matrix("color")[:3, 0] * metres
    return known.replace(translations=places)


def finding(operator: ColorDepthCheck, known: Transforms) -> tuple[str, list[Transforms]]:
    """What is found over the views, and the corrected extrinsics."""
    operator.setup()
    seen = zip(*pairs(), strict=True)
    made = [operator.process(image, depth, info("color"), info("depth"), known) or {} for image, depth in seen]
    return operator.finding(), [each["corrected"] for each in made if "corrected" in each]


def figures(pattern: str, text: str) -> list[float]:
    told = re.search(pattern, text)
    assert told is not None, text
    return [float(each) for each in told.groups()]


def test_displaced_or_rotated_camera_is_reported_with_the_correction() -> None:
    text, given = finding(ColorDepthCheck(period="200ms"), displaced(-0.08))
    assert figures(r"with the colour camera (\S+) cm to the right and (\S+) cm down", text) == pytest.approx(
        [8, 0], abs=2
    )
    assert given == []
    text, _ = finding(ColorDepthCheck(period="200ms"), extrinsics(color=("y", 3.0)))
    assert figures(r"turned by (\S+)° to the right", text) == pytest.approx([-3], abs=0.6)
    text, _ = finding(ColorDepthCheck(period="200ms"), displaced(0.05))  # a turn fits about as well
    assert text.endswith("a camera is turned or displaced against its extrinsic")


def test_calibration_brings_the_camera_nearer_step_by_step_and_reports_it() -> None:
    text, given = finding(ColorDepthCheck(period="200ms", calibrate=True), displaced(0.12))
    away = [float(np.linalg.norm(transform_between(each, "color", "depth")[:3, 3])) for each in given]
    assert len(away) >= 2
    assert away[0] == pytest.approx(0.12)
    assert away[-1] < 0.07
    assert figures(r"was put (\S+) cm to the right", text) == pytest.approx([100 * (away[-1] - away[0])], abs=0.2)
    text, given = finding(ColorDepthCheck(period="200ms", calibrate=True), extrinsics(color=("y", -3.0)))
    assert len(given) == 2
    assert figures(r"turned by (\S+)° to the right", text) == pytest.approx([1.5], abs=0.4)  # half of it


def boards(seed: int, shift: Callable[[float], float]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Returns an image of boards near and far, moved right by `shift(depth)` pixels, and points on their rims."""
    rng, width, height = np.random.default_rng(seed), 640, 480
    image, points = np.full((height, width), 40, np.uint8), []
    for depth in (3.0, 3.0, 3.0, 1.0, 1.0, 1.0):
        side = int(120 / depth) + 20
        u, v = int(rng.uniform(80, width - 80 - side)), int(rng.uniform(80, height - 80 - side))
        moved = u + round(shift(depth))
        image[v : v + side, moved : moved + side] = rng.integers(120, 255)
        edge = np.arange(side)
        for x, y in ((u + edge, v), (u + edge, v + side), (u, v + edge), (u + side, v + edge)):
            rays = np.stack(np.broadcast_arrays((x - 320) / 525, (y - 240) / 525, 1.0), axis=1)
            points.append(depth * rays)
    return image, np.concatenate(points)


@pytest.mark.parametrize(
    ("shift", "displacement", "turn"),
    [(lambda z: 525 * 0.03 / z, 0.03, 0.0), (lambda z: -16.0, 0.0, -16 / 525), (lambda z: 0.0, 0.0, 0.0)],
)
def test_near_and_far_edges_tell_a_displaced_camera_from_a_turned_one(
    shift: Callable[[float], float], displacement: float, turn: float
) -> None:
    camera = np.array([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]])
    alignment = EdgeAlignment()
    for seed in range(10):
        image, points = boards(seed, shift)
        alignment.add(image, camera, points)
    found = alignment.correction(camera)
    assert found.displacement == pytest.approx((displacement, 0), abs=0.005)
    assert found.turn == pytest.approx((turn, 0), abs=0.005)


def test_edges_come_nearer_where_a_turn_fits_about_as_well_as_a_displacement() -> None:
    """Either puts them where they should be, at the distances that are seen."""
    _, given = finding(ColorDepthCheck(period="200ms", calibrate=True), displaced(0.05))
    assert len(given) == 2
    off = []
    for known in given:
        alignment, T = EdgeAlignment(), transform_between(known, "depth", "color")
        for image, depth in zip(*pairs(), strict=True):
            alignment.add(image.data, K, rims(depth.data, K) @ T[:3, :3].T + T[:3, 3])
        off.append(abs(alignment.shifts()[0].x))
    assert off[0] >= 3
    assert off[1] <= 0.7 * off[0]


def test_the_tree_of_the_extrinsics_stays_one_when_a_camera_is_moved() -> None:
    chain = displaced(0.12)
    star = chain.replace(
        frames=("base", "base", "base"),
        translations=np.array([transform_between(chain, child, "base")[:3, 3] for child in chain.child_frames]),
        rotations=np.array([chain.rotations[0], chain.rotations[0], chain.rotations[2]]),
    )
    last = [finding(ColorDepthCheck(period="200ms", calibrate=True), known)[1][-1] for known in (chain, star)]
    for child in ("depth", "color", "lidar"):
        a, b = (transform_between(each, child, "base") for each in last)
        assert a == pytest.approx(b, abs=1e-9)


def test_one_frame_for_both_cameras_leaves_nothing_to_calibrate() -> None:
    image, depth = (stream[0] for stream in pairs())
    both = depth.replace(frame="color")
    given = (image, both, info("color"), info("color"), extrinsics())
    assert set(ColorDepthCheck().process(*given) or {}) == {"status"}
    with pytest.raises(ValueError, match="both in frame 'color'"):
        ColorDepthCheck(calibrate=True).process(*given)
