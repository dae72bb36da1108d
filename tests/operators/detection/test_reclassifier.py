"""Small things named anew by close-ups: what is looked at, what changes, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.firing.failure import OperatorFailure
from dataflow.messages import Detections2D, Image
from dataflow.testing import play
from operators.detection import Reclassifier
from operators.detection.reclassify.closeups import AROUND, SIDE, closeups
from operators.detection.reclassify.model import ReclassifierModel
from operators.weights import NetworkFileError, shipped
from tests.support.drives import Drive, right

NAMES = ("mug", "ball", "person")
F32 = NDArray[np.float32]


def opened(**params: Any) -> Reclassifier:
    operator = Reclassifier(**params)
    operator.setup()
    return operator


def sure_of(name: str) -> Any:
    """A network for which everything is that."""

    def judge(_: ReclassifierModel, pixels: NDArray[np.uint8], boxes: F32) -> F32:
        classes = ReclassifierModel.open(shipped("reclassifier.onnx")).classes
        return np.tile(np.where(np.array(classes) == name, 0.9, 0.02).astype(np.float32), (len(boxes), 1))

    return judge


def detections(*rows: tuple[str, float, tuple[float, float, float, float]]) -> Detections2D:
    return Detections2D(
        stamp=0, frame="lens", width=160, height=120, class_names=NAMES, boxes=[box for _, _, box in rows],
        scores=[score for _, score, _ in rows], class_ids=[NAMES.index(name) for name, _, _ in rows],
    )  # fmt: skip


BLANK = Image(stamp=0, frame="lens", data=np.full((120, 160, 3), 90, np.uint8))


def test_a_closeup_shows_the_box_and_what_is_around_it() -> None:
    pixels = np.zeros((60, 80, 3), np.uint8)
    pixels[20:40, 30:50] = 200
    (seen,) = closeups(pixels, np.array([[30, 20, 50, 40]], np.float32))
    assert seen.shape == (SIDE, SIDE, 3)
    shown = (seen[..., 0] > 100).any(axis=0).sum() / SIDE
    assert shown == pytest.approx(1 / AROUND, abs=0.05)
    beyond = closeups(pixels, np.array([[76, 56, 96, 76], [-30, -30, -10, -10]], np.float32))
    assert (beyond == 0).all()


def test_names_are_those_of_the_closeups_and_scores_products(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReclassifierModel, "judge", sure_of("ball"))
    given = detections(
        ("person", 0.9, (10, 10, 40, 100)), ("mug", 0.8, (60, 60, 80, 80)), ("ball", 0.5, (110, 50, 125, 65)),
        ("mug", 0.4, (0, 0, 130, 90)),
    )  # fmt: skip
    operator = opened()
    made = operator.process(BLANK, given)
    assert made.labels() == ("person", "ball", "ball", "mug")  # the last is too large
    doubt = 0.05
    renamed = 0.9 * doubt / (0.9 * doubt + 0.02)  # the detector's class is believed, too
    kept = 0.9 / (0.9 + 0.02 * doubt)
    np.testing.assert_allclose(made.scores, [0.9, 0.8 * renamed, 0.5 * kept, 0.4], rtol=1e-5)
    assert operator.summary() == {"images": 1, "looked at": 2, "renamed": 1}
    unlike = opened(doubt=0.001).process(BLANK, given)
    assert unlike.labels().count("ball") == 1


def test_a_renamed_box_joins_a_surer_one_of_its_new_class(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReclassifierModel, "judge", sure_of("ball"))
    same = (60.0, 60.0, 80.0, 80.0)
    made = opened().process(BLANK, detections(("ball", 0.8, same), ("mug", 0.6, (61, 60, 80, 80))))
    assert made.labels() == ("ball",)
    both = opened().process(BLANK, detections(("ball", 0.8, same), ("ball", 0.6, (61, 60, 80, 80))))
    assert both.labels() == ("ball", "ball")  # the detector kept them apart


def test_all_that_is_told_of_a_detection_stays_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReclassifierModel, "judge", sure_of("ball"))
    given = detections(("mug", 0.8, (60, 60, 80, 80)), ("ball", 0.7, (110, 50, 125, 65))).replace(
        ids=np.array([7, 9]), visible=np.array([0.5, 1.0], np.float32)
    )
    made = opened(doubt=0.01).process(BLANK, given)
    assert made.ids is not None
    assert dict(zip(made.ids.tolist(), made.labels(), strict=True)) == {7: "mug", 9: "ball"}
    assert made.ids.tolist() == [9, 7]


def test_a_detector_of_one_class_keeps_it_where_the_closeup_is_like_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReclassifierModel, "judge", lambda _, __, boxes: np.eye(6, dtype=np.float32)[[1] * len(boxes)])
    given = detections(("mug", 0.8, (60, 60, 80, 80))).replace(class_names=("mug",))
    made = opened().process(BLANK, given)
    assert made.labels() == ("mug",)
    assert made.scores.tolist() == given.scores.tolist()


def test_fewer_small_things_of_the_recording_have_a_wrong_name(drive: Drive) -> None:
    operator = opened()
    made = [operator.process(*each) for each in zip(drive.images, drive.detections, strict=True)]
    names = ReclassifierModel.open(shipped("reclassifier.onnx")).classes
    before, after = right(drive, drive.detections, names), right(drive, made, names)
    assert after[1] >= before[1]
    assert after[2] < before[2]


def test_equal_images_give_equal_names(drive: Drive) -> None:
    streams = {"image": drive.images, "detections": drive.detections}
    first, again = (play(Reclassifier(), streams).outputs["renamed"] for _ in range(2))
    assert len(first) == len(drive.images)
    assert [m.digest() for m in first] == [m.digest() for m in again]


def test_what_it_does_not_know_is_passed_on_and_other_images_and_files_are_refused(drive: Drive) -> None:
    image, given = drive.images[0], drive.detections[0]
    foreign = given.replace(class_names=tuple(f"other {k}" for k, _ in enumerate(given.class_names)))
    assert opened().process(image, foreign) is foreign
    other = Image(stamp=given.stamp, frame="lens", data=np.zeros((100, 100, 3), np.uint8))
    with pytest.raises(OperatorFailure, match="an image of 320x240 pixels, this one has 100x100"):
        play(Reclassifier(), {"image": [other], "detections": [given]})
    with pytest.raises(NetworkFileError, match="is a detector; a reclassifier is needed: `dataflow train reclassifier"):
        opened(weights=str(shipped("detector.onnx")))
