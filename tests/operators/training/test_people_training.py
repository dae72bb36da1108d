"""Training of activities by command, on made episodes; and episodes of simulated worlds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from operators.recognition.activity.episodes import Episode
from operators.recognition.activity.features import COUNT
from operators.recognition.activity.recognizer import ActivityModel
from operators.recognition.activity.samples import macro_f1
from operators.recognition.activity.sensed_people import SensedTrack, write_tracks
from operators.recognition.posture.data import BODY, POSTURES, Postures
from operators.recognition.posture.recognizer import PostureModel
from operators.recognition.posture.silhouette import MIDDLE, SIDE
from operators.simulator.classes import ACTIVITIES
from operators.training import simulated_postures
from operators.training.commands import train
from operators.training.made_worlds import worlds
from operators.training.simulated_people import TRAINING, VALIDATION, read_episodes, watched, write_episodes
from operators.weights import NetworkFileError, trained_in_simulation

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.learning.balance import class_weights
    from operators.recognition.posture.training import PostureTask, mirrored


def made(seed: int) -> Episode:
    """Somebody walks to one of two chairs, stands for a second, sits down and sits."""
    rng = np.random.default_rng(seed)
    times = np.arange(10 * 8) / 8
    goal = int(rng.integers(2))
    chairs = np.array([[3.0, -1.5], [3.0, 1.5]])
    way = (chairs[goal] - [0.5, 0]) * np.clip(times / 5, 0, 1)[:, None]
    sunk = np.clip((times - 6) / 1.7, 0, 1)
    boxes = np.zeros((len(times), 3, 7), np.float32)
    boxes[:, 0] = (0, 0, 0, 0.4, 0.5, 0, 0)
    boxes[:, 0, :2] = way
    boxes[:, 0, 5] = 1.7 - 0.4 * sunk
    boxes[:, 0, 2] = boxes[:, 0, 5] / 2
    for k, (x, y) in enumerate(chairs):
        boxes[:, 1 + k] = (x, y, 0.45, 0.5, 0.5, 0.9, 0)
    names = ("walking", "standing", "sitting_down", "sitting")
    said = tuple((names[int(np.searchsorted([5, 6, 7.7], t, side="right"))],) for t in times)
    camera = np.tile(np.eye(4), (len(times), 1, 1))
    camera[:, :3, :3] = np.stack([[0, -1, 0], [0, 0, -1], [1, 0, 0]], axis=1)
    camera[:, :3, 3] = (-3.0, 0.0, 1.0)
    return Episode(
        f"made {seed}", times, np.array([7, 5, 6]), ("person", "chair", "chair"), boxes, camera, np.array([7]), said,
        np.full((len(times), 1), 5 + goal),
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of episodes that lacks none, so that no world is made."""
    folder = tmp_path_factory.mktemp("people")
    for kind, seed, people in (*worlds(TRAINING, 3), *worlds(VALIDATION, 1)):
        made(seed).write(folder / f"{kind}_{seed}_{people}.npz")
    return folder


WORDS = ["--worlds", "3", "--validation", "1", "--variations", "1"]


def test_the_activity_network_is_trained_scored_and_written(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "activity.onnx"
    words = ["activity", str(folder), "--out", str(out), *WORDS, "--epochs", "2", "--json"]
    done = CliRunner().invoke(train, words)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert 0 <= told["scores"]["score"] <= 1
    assert len(told["history"]) == 2
    assert trained_in_simulation(out)
    model = ActivityModel.open(out)
    features = np.zeros((3, COUNT), np.float32)
    probabilities, states = model.step(features, np.stack([model.fresh()] * 3))
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, rtol=1e-5)
    assert states.shape == (3, 2, model.layers, model.width)
    alone, _ = model.step(features[:1], model.fresh()[None])
    np.testing.assert_allclose(alone[0], probabilities[0], rtol=1e-5)


def test_tracks_as_sensors_gave_them_are_trained_on_and_scored(folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    labels = np.repeat([-1, 1, 3], [2, 6, 6])
    right = np.zeros((14, len(ACTIVITIES)), bool)
    right[np.arange(14), np.maximum(labels, 0)] = True
    features = rng.normal(0, 1, (14, COUNT)).astype(np.float32)
    sensed = tmp_path / "sensed"
    sensed.mkdir()
    write_tracks(sensed / "1.npz", [SensedTrack(features, labels, labels, right, labels >= 0)])
    words = ["activity", str(folder), "--out", str(tmp_path / "a.onnx"), *WORDS, "--epochs", "1", "--json"]
    done = CliRunner().invoke(train, [*words, "--sensed", str(sensed), "--sensed-validation", str(sensed)])
    assert done.exit_code == 0, done.output
    assert 0 <= json.loads(done.stdout)["scores"]["sensed"] <= 1


def test_equal_seeds_give_equal_networks(folder: Path, tmp_path: Path) -> None:
    answers = []
    for file in (tmp_path / "a.onnx", tmp_path / "b.onnx"):
        words = ["activity", str(folder), "--out", str(file), *WORDS, "--epochs", "1", "--json"]
        done = CliRunner().invoke(train, words)
        assert done.exit_code == 0, done.output
        model = ActivityModel.open(file)
        answers.append(model.step(np.ones((2, COUNT), np.float32), np.stack([model.fresh()] * 2))[0].tobytes())
    assert answers[0] == answers[1]


def test_an_earlier_network_is_not_lost(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "activity.onnx"
    out.write_bytes(b"mine")
    done = CliRunner().invoke(train, ["activity", str(folder), "--out", str(out), *WORDS])
    assert done.exit_code == 2
    assert out.read_bytes() == b"mine"


def test_a_simulated_world_gives_boxes_activities_and_goals() -> None:
    episode = watched("table_top", 40_001, 3, rate=2.0, seconds=3.0)
    assert episode.boxes.shape == (6, len(episode.ids), 7)
    assert np.isfinite(episode.boxes).all()
    assert set(episode.agents.tolist()) <= set(episode.ids.tolist())
    assert len(episode.activities[0]) == len(episode.agents)
    goals = set(episode.goals.ravel().tolist()) - {-1}
    assert goals <= set(episode.ids.tolist())
    assert any(label == "person" for label in episode.labels)


def test_episodes_that_are_there_are_not_made_again(folder: Path) -> None:
    assert list(write_episodes(folder, worlds(TRAINING, 3), 1)) == []
    assert [e.name for e in read_episodes(folder, worlds(TRAINING, 2))] == ["made 40000", "made 40001"]


def test_unknown_is_a_miss_and_false_for_no_class() -> None:
    assert macro_f1(["a", "a", "b", "b"], ["a", "unknown", "b", "b"]) == pytest.approx((2 / 3 + 1) / 2)
    assert macro_f1(["a", "b"], ["a", "a"]) == pytest.approx((2 / 3) / 2)
    assert macro_f1([], []) == 0
    assert macro_f1(["a", "a", "a"], ["a", "a", "b"]) == pytest.approx((4 / 5 + 0) / 2)  # said, and never true


def test_the_posture_network_is_trained_scored_and_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    folder, out = tmp_path / "silhouettes", tmp_path / "posture.onnx"
    folder.mkdir()
    for kind, seed, people in (*worlds(simulated_postures.TRAINING, 2), *worlds(simulated_postures.VALIDATION, 1)):
        activities = np.arange(21) % len(POSTURES)
        shapes = np.zeros((21, 3, SIDE, SIDE), np.int8)
        for shape, activity in zip(shapes, activities, strict=True):
            shape[:2, 4 + 8 * activity : 10 + 8 * activity, 20:44] = 127
        Postures(shapes, rng.normal(0, 0.3, (21, BODY)).astype(np.float32), activities).write(
            folder / f"{kind}_{seed}_{people}.npz"
        )
    words = f"posture {folder} --out {out} --worlds 2 --validation 1 --epochs 2 --batch 8 --json"
    done = CliRunner().invoke(train, words.split())
    assert done.exit_code == 0, done.output
    assert 0 <= json.loads(done.stdout)["scores"]["score"] <= 1
    assert trained_in_simulation(out)
    model = PostureModel.open(out)
    both = model.judge(shapes[:2].astype(np.float32) / 127)
    np.testing.assert_allclose(both.sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(model.judge(shapes[1:2].astype(np.float32) / 127)[0], both[1], rtol=1e-4)


@pytest.mark.long
def test_simulated_people_are_seen_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated_postures, "_LOOKS", 2)
    monkeypatch.setattr(simulated_postures, "_MORE", 0)
    found, again = (simulated_postures.looked_at("table_top", 45_501, 2) for _ in range(2))
    assert found.silhouettes.tobytes() == again.silhouettes.tobytes()
    assert {"sitting", "walking"} <= {POSTURES[k] for k in found.activities}
    pelvis = found.bodies[:, 14] + MIDDLE  # metres over the floor
    seated, walking = (found.activities == POSTURES.index(name) for name in ("sitting", "walking"))
    assert pelvis[seated].max() < 0.7 < pelvis[walking].min()
    highest = np.array([(shape[0] != 0).any(axis=1).argmax() for shape in found.silhouettes])
    assert np.median(highest[seated]) > np.median(highest[walking]) + 5  # rows count from above


def test_a_mirrored_silhouette_has_a_mirrored_body() -> None:
    rng = np.random.default_rng(1)
    shape, body = rng.random((3, SIDE, SIDE)).astype(np.float32), rng.random(BODY).astype(np.float32)
    once = mirrored(shape, body)
    np.testing.assert_array_equal(once[0], shape[:, :, ::-1])
    np.testing.assert_allclose(once[1][:3], body[3:6] * [-1, 1, 1])
    twice = mirrored(*once)
    np.testing.assert_array_equal(twice[0], shape)
    np.testing.assert_allclose(twice[1], body)


def test_networks_of_other_windows_and_files_without_silhouettes_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "other.onnx"
    shapes, bodies = np.zeros((7, 3, SIDE, SIDE), np.int8), np.zeros((7, BODY), np.float32)
    made = Postures(shapes, bodies, np.arange(7))
    task = PostureTask(made, made)
    task.export(task.network.eval(), {"side": 32}, file)
    with pytest.raises(NetworkFileError, match=r"is made for side 32, half "):
        PostureModel.open(file)
    np.savez(tmp_path / "foreign.npz", silhouettes=shapes)
    with pytest.raises(ValueError, match=r"foreign.npz holds no activities, bodies: delete it"):
        Postures.read(tmp_path / "foreign.npz")


def test_rare_classes_count_more_but_not_by_all_that_they_lack() -> None:
    labels = np.repeat([0, 1, 2], [90, 10, 1])
    weights = class_weights(labels, 4).numpy()
    np.testing.assert_allclose(weights[labels].mean(), 1, rtol=1e-5)
    np.testing.assert_allclose(weights[1] / weights[0], 3, rtol=1e-5)
    assert np.isfinite(weights).all()
