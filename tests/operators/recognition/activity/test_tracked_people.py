"""What the model of a tracker makes of an episode: repeatable, within its bounds, and as it is where it is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from operators.recognition.activity.episodes import Episode
from operators.recognition.activity.features import COUNT
from operators.recognition.activity.samples import labels_of, right_within, tracked_sequences, true_sequences
from operators.recognition.activity.tracked_people import tracked_moments, true_moments

CLASSES = ("standing", "walking", "sitting_down")


def episode(seconds: float = 12.0) -> Episode:
    """A person walks along x for 6 s to a chair, stands for 2 s, and begins to sit down; the camera looks at both."""
    times = np.arange(round(seconds * 8)) / 8
    x = 0.6 * np.minimum(times, 6.0)
    boxes = np.zeros((len(times), 3, 7), np.float32)
    boxes[:, 0] = (0, 0, 0.85, 0.4, 0.55, 1.7, 0)
    boxes[:, 0, 0] = x
    boxes[:, 1] = (4.1, 0, 0.45, 0.5, 0.5, 0.9, 0)
    boxes[:, 2] = (9, 9, 1, 1, 0.3, 2, 0)
    camera = np.tile(np.eye(4), (len(times), 1, 1))
    camera[:, :3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], axis=1)  # looks along +y
    camera[:, :3, 3] = (2.0, -4.0, 0.9)
    said = tuple(("walking" if t < 6 else "standing" if t < 8 else "sitting_down",) for t in times)
    return Episode(
        "made", times, np.array([7, 5, 6]), ("person", "chair", "shelf"), boxes, camera, np.array([7]), said,
        np.full((len(times), 1), 5),
    )  # fmt: skip


def test_true_moments_omit_irrelevant_objects() -> None:
    made = episode()
    moments = list(true_moments(made, 2))
    assert [m.row for m in moments] == list(range(0, 96, 2))
    assert {b.label for b in moments[0].bodies} == {"person", "chair"}
    np.testing.assert_allclose(moments[5].bodies[0].center, made.boxes[10, 0, :3])


def test_simulated_tracks_are_determined_by_the_seed() -> None:
    first, again, other = (tracked_sequences(episode(), 2, np.random.default_rng(seed)) for seed in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.features, b.features)
    assert [t.features.tobytes() for t in first] != [t.features.tobytes() for t in other]


def test_person_outside_the_image_is_kept_in_place_for_six_seconds() -> None:
    made = episode(20.0)
    behind = made.camera.copy()
    behind[40:, :3, :3] = behind[40:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])  # it looks the other way from 5 s on
    turned = Episode(**(vars(made) | {"camera": behind}))
    for seed in range(40):
        moments = list(tracked_moments(turned, 1, np.random.default_rng(seed)))
        there = [m for m in moments if 7 in m.unseen]
        if any(m.unseen[7] > 4 for m in there):
            places = {b.center.tobytes() for m in there if m.time >= 5.2 for b in m.bodies if b.id == 7}
            assert len(places) == 1
            assert max(m.unseen[7] for m in there) <= 6.01
            return
    raise AssertionError("no seed had a camera that sees only what is before it")


def test_features_are_finite_and_labels_trail_by_a_quarter_of_a_second() -> None:
    made = episode()
    (track,) = true_sequences(made, 1)
    assert track.features.shape == (96, COUNT)
    assert np.isfinite(track.features).all()
    labels = labels_of(made, track, CLASSES)
    assert labels[49] == CLASSES.index("walking")
    assert labels[50] == CLASSES.index("standing")
    right = right_within(made, track, CLASSES, 0.5)
    assert right[46].tolist() == [True, True, False]


def test_episode_survives_its_file(tmp_path: Path) -> None:
    made = episode()
    made.write(tmp_path / "made.npz")
    read = Episode.read(tmp_path / "made.npz")
    assert (read.name, read.labels, read.activities) == (made.name, made.labels, made.activities)
    np.testing.assert_array_equal(read.boxes, made.boxes)
