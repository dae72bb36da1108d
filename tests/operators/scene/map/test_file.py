"""Maps of objects that are saved, with the classes learned for them, and gone on with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_scene import INFO, Solid, camera, look

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Boxes3D, Clusters, PointCloud, Pose
from dataflow.testing import Played, play
from operators.scene import ObjectLifter, SemanticMap
from operators.scene.map.file import LearnedFile, SavedMap, learned_files, together

SECOND = 1_000_000_000
CRATE: Solid = ((2.5, 0.5, 0.25), (0.5, 0.4, 0.5), 0.3, 0)
OTHER: Solid = ((2.8, -0.8, 0.2), (0.4, 0.4, 0.4), 0.0, 0)
View = tuple[Boxes3D, Clusters, PointCloud, Pose]


@pytest.fixture(scope="module")
def shown() -> list[View]:
    """What the lifter gives for two things, seen five times a second from changing places."""
    lifter = ObjectLifter()
    lifter.setup()
    made = []
    for k in range(8):
        pose = camera((k + 1) * SECOND // 5, (0.3 * np.sin(k), 0.9 * np.sin(0.7 * k), 1.0), 0.15 * np.sin(k))
        cloud, detections, masks = look(pose, [CRATE, OTHER], noise=0.004)
        found = lifter.process(detections, cloud, INFO, segmentation=masks, pose=pose)
        made.append((found["boxes"], found["clusters"], cloud, pose))
    return made


def mapped(given: Sequence[View], **params: Any) -> Played:
    streams = {name: [view[k] for view in given] for k, name in enumerate(("boxes", "clusters", "cloud", "pose"))}
    return play(SemanticMap(**{"labels": "simulator", **params}), streams)


def last(played: Played) -> Boxes3D:
    return played["objects"][-1]


@pytest.fixture
def saved(shown: list[View], tmp_path: Path) -> Path:
    file = tmp_path / "room.map.npz"
    mapped(shown, save=str(file))
    return file


def test_a_saved_map_is_known_from_the_first_view_on(shown: list[View], saved: Path) -> None:
    assert last(mapped(shown[:1])).count == 0  # one view alone confirms nothing
    known = mapped(shown[:1], map_file=str(saved))
    before, after = last(mapped(shown)), last(known)
    assert after.ids.tolist() == before.ids.tolist() == [1, 2]
    np.testing.assert_allclose(after.centers, before.centers, atol=0.05)
    nodes = known["nodes"][-1]
    assert (nodes.last_seen <= after.stamp).all()  # though the map was saved at a later time than this


def test_equal_maps_are_equal_files_and_are_read_as_they_were_written(
    shown: list[View], saved: Path, tmp_path: Path
) -> None:
    mapped(shown, save=str(tmp_path / "deep/second.npz"))
    assert (tmp_path / "deep/second.npz").read_bytes() == saved.read_bytes()
    SavedMap.read(saved).write(tmp_path / "copy.npz")
    assert (tmp_path / "copy.npz").read_bytes() == saved.read_bytes()


def test_movable_objects_are_not_loaded_from_the_map_file(shown: list[View], saved: Path) -> None:
    assert set(last(mapped(shown)).labels()) == {"box"}
    boxes_move = Path(__file__).parents[1] / "label_spaces" / "boxes_move.yaml"
    assert last(mapped(shown[:1], map_file=str(saved), labels=str(boxes_move))).count == 0


def test_classes_are_taken_over_by_name_also_where_more_were_learned_since(shown: list[View], saved: Path) -> None:
    name = last(mapped(shown)).labels()[0]
    boxes, clusters, cloud, pose = shown[0]
    more = boxes.replace(class_names=("teapot", *boxes.class_names), class_ids=boxes.class_ids + 1)
    assert set(last(mapped([(more, clusters, cloud, pose)], map_file=str(saved))).labels()) == {name}
    fewer = boxes.replace(class_names=tuple(f"other {k}" for k in range(len(boxes.class_names))))
    with pytest.raises(OperatorFailure, match="which boxes do not have"):
        mapped([(fewer, clusters, cloud, pose)], map_file=str(saved))


def test_learned_classes_are_held_and_come_back_with_the_map(shown: list[View], tmp_path: Path) -> None:
    first, second = tmp_path / "teapot.object.npz", tmp_path / "cone.object.npz"
    first.write_bytes(b"the teapot")
    second.write_bytes(b"the cone")
    file, later = tmp_path / "room.map.npz", tmp_path / "later.map.npz"
    mapped(shown[:2], save=str(file), learned=[str(first)])
    first.unlink()
    assert learned_files(file) == (LearnedFile("teapot.object.npz", b"the teapot"),)
    mapped(shown[:2], map_file=str(file), save=str(later), learned=[str(file), str(second)])
    assert [each.name for each in learned_files(later)] == ["teapot.object.npz", "cone.object.npz"]
    teapot, cone = learned_files(later)
    assert together([teapot], [cone, replace(teapot, name="copy")]) == (teapot, cone)


def test_maps_that_do_not_fit_are_refused(shown: list[View], saved: Path, tmp_path: Path) -> None:
    with pytest.raises(OperatorFailure, match=r"no file .*none\.npz"):
        mapped(shown[:1], map_file=str(tmp_path / "none.npz"))
    with pytest.raises(OperatorFailure, match=r"voxels of 0.03 m, but voxel is 0.05"):
        mapped(shown[:1], map_file=str(saved), voxel=0.05)
    replace(SavedMap.read(saved), frame="elsewhere").write(tmp_path / "elsewhere.npz")
    with pytest.raises(OperatorFailure, match="'elsewhere'"):
        mapped(shown[:1], map_file=str(tmp_path / "elsewhere.npz"))


def test_files_that_are_no_maps_are_refused(saved: Path, tmp_path: Path) -> None:
    broken, strange = tmp_path / "broken.npz", tmp_path / "strange.npz"
    broken.write_bytes(saved.read_bytes()[:200])
    np.savez(strange, points=np.zeros(3))
    for file in (broken, strange):
        with pytest.raises(ValueError, match=r"is no saved map .*parameter save"):
            SavedMap.read(file)
    learned = LearnedFile("teapot.object.npz", b"the teapot")
    replace(SavedMap.read(saved), learned=(learned,)).write(tmp_path / "held.npz")
    with np.load(tmp_path / "held.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(tmp_path / "changed.npz", **{**arrays, "learned_0": np.frombuffer(b"something else", np.uint8)})
    with pytest.raises(ValueError, match=r"teapot.object.npz is not the one that was saved"):
        SavedMap.read(tmp_path / "changed.npz")
