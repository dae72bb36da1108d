"""The classifier, trained by command on made pictures, on new images and on detected objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_pictures import SHAPES, image, picture, scene

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Detections2D
from dataflow.testing import play
from operators.recognition import ImageClassifier
from operators.weights import shipped


@pytest.mark.long
def test_new_images_get_their_class(good_classifier: Path) -> None:
    shown = [(shape, image(picture(shape, 500 + i), i)) for i, shape in enumerate(SHAPES * 5)]
    found = play(ImageClassifier(weights=str(good_classifier)), {"image": [i for _, i in shown]})["classes"]
    right = [message.labels() == (shape,) for (shape, _), message in zip(shown, found, strict=True)]
    assert np.mean(right) >= 0.9
    assert found[0].class_names == SHAPES
    np.testing.assert_allclose([message.probabilities.sum() for message in found], 1.0, rtol=1e-4)


@pytest.mark.long
def test_each_object_of_the_image_gets_its_class_and_keeps_its_id(good_classifier: Path) -> None:
    shown, boxes = scene()
    operator = ImageClassifier(weights=str(good_classifier), per="object")
    (found,) = play(operator, {"image": [shown], "detections": [boxes]})["classes"]
    assert found.labels() == ("disc", "stripes")
    assert found.ids.tolist() == [7, 9]


def test_an_image_in_which_nothing_was_detected_has_no_rows_and_all_classes(classifier: Path) -> None:
    shown, boxes = scene()
    nothing = boxes.replace(boxes=np.zeros((0, 4)), scores=np.zeros(0), class_ids=np.zeros(0, np.int32), ids=[])
    operator = ImageClassifier(weights=str(classifier), per="object")
    (found,) = play(operator, {"image": [shown], "detections": [nothing]})["classes"]
    assert found.probabilities.shape == (0, len(SHAPES))
    assert operator.summary() == {}


def test_rows_below_the_threshold_are_left_out_with_their_ids(classifier: Path) -> None:
    shown, boxes = scene()
    given = {"image": [shown], "detections": [boxes]}
    (sure,) = play(ImageClassifier(weights=str(classifier), per="object"), given)["classes"]
    between = float(np.mean(sure.scores))
    (few,) = play(ImageClassifier(weights=str(classifier), per="object", threshold=between), given)["classes"]
    assert few.ids.tolist() == [int(sure.ids[int(sure.scores.argmax())])]
    (none,) = play(ImageClassifier(weights=str(classifier), per="object", threshold=1.0), given)["classes"]
    assert len(none.ids) <= 1


def test_a_grey_image_is_seen_as_a_colourless_one(classifier: Path) -> None:
    grey = picture("disc", 900).mean(axis=2).astype(np.uint8)
    operator = ImageClassifier(weights=str(classifier))
    first, second = play(operator, {"image": [image(grey), image(np.repeat(grey[..., None], 3, 2), 1)]})["classes"]
    np.testing.assert_array_equal(first.probabilities, second.probabilities)


def test_a_network_of_another_kind_is_refused() -> None:
    shown: tuple[object, Detections2D] = scene()
    with pytest.raises(OperatorFailure, match="is a detector; a classifier is needed"):
        play(ImageClassifier(weights=str(shipped("detector.onnx"))), {"image": [shown[0]]})
