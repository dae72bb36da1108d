"""The segmenter from a folder of masks to class maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import Image
from operators.detection.custom.dataset import DataError
from operators.inference import ModelError
from operators.learning.augmentation import Variation
from operators.segmentation import Segmenter
from operators.segmentation.assessment import assess
from operators.segmentation.dataset import VOID, read_segmentation_data
from operators.segmentation.score import class_iou, confusion, mean_iou
from operators.weights import NetworkFileError

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.learning.export import export_network
    from operators.learning.loop import Settings, train
    from operators.segmentation.network import DeployedSegmenter, SegmentationNetwork, enlarged
    from operators.segmentation.training import SegmenterTask, class_weights, dice_loss


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A grey wall above a brown floor, and a green disc: classes 0, 1, 2; two columns are void."""
    rng = np.random.default_rng(seed)
    pixels, mask = np.zeros((96, 128, 3), np.uint8), np.zeros((96, 128), np.uint8)
    horizon = int(rng.integers(30, 70))
    pixels[:horizon], pixels[horizon:], mask[horizon:] = (150, 150, 155), (120, 80, 40), 1
    center, radius = tuple(int(v) for v in rng.integers(25, 75, 2)), int(rng.integers(10, 20))
    cv2.circle(pixels, center, radius, (30, 180, 60), -1)
    cv2.circle(mask, center, radius, 2, -1)
    mask[:, :2] = VOID
    return np.clip(pixels + rng.normal(0, 8, pixels.shape), 0, 255).astype(np.uint8), mask


def write_folder(folder: Path, count: int, seed: int = 0) -> Path:
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    (folder / "classes.txt").write_text("wall\nfloor\nball\n")
    for i in range(count):
        pixels, mask = scene(seed + i)
        cv2.imwrite(str(folder / "images" / f"{i:03d}.jpg"), pixels[..., ::-1])
        cv2.imwrite(str(folder / "masks" / f"{i:03d}.png"), mask)
    return folder


def test_data_with_validation_images_only_is_trained_on_with_a_note(tmp_path: Path) -> None:
    write_folder(tmp_path, 2)
    (tmp_path / "val.txt").write_text("000.jpg\n001.jpg\n")
    data = read_segmentation_data(tmp_path)
    assert data.training == data.validation
    assert "trained on too" in data.notes[0]
    (tmp_path / "classes.txt").write_bytes(b"wall\nfl\xffor\n")
    with pytest.raises(DataError, match=r"classes\.txt:2: byte 0xff is not UTF-8"):
        read_segmentation_data(tmp_path)


@pytest.mark.long
def test_a_folder_of_masks_becomes_a_segmenter(tmp_path: Path) -> None:
    data = read_segmentation_data(write_folder(tmp_path / "data", 20))
    variation = Variation(color=0.1, noise=4, scale=1.2)
    task = SegmenterTask(data, (128, 96), width=0.25, variation=variation)
    out = tmp_path / "network.onnx"
    outcome = train(task, Settings(epochs=10, batch=4, learning_rate=5e-3, threads=1, evaluate_every=5), out)
    assert outcome.best["miou"] > 0.7
    unseen = read_segmentation_data(write_folder(tmp_path / "unseen", 8, seed=500))
    scored = assess(out, unseen.classes, (*unseen.training, *unseen.validation))
    assert scored["miou"] > 0.7
    assert set(scored["per_class"]) == {"wall", "floor", "ball"}

    made, again = (Segmenter(weights=str(out), with_confidence=True) for _ in range(2))
    made.setup()
    again.setup()
    pixels, mask = scene(900)
    large = Image(stamp=3, frame="camera", data=np.ascontiguousarray(np.kron(pixels, np.ones((4, 4, 1), np.uint8))))
    found = made.process(large)
    assert found.digest() == again.process(large).digest()
    assert found.classes.shape == (384, 512)
    assert found.class_names == ("wall", "floor", "ball")
    known = np.kron(mask, np.ones((4, 4), np.uint8)) != VOID
    assert (found.classes[known] == np.kron(mask, np.ones((4, 4), np.uint8))[known]).mean() > 0.9

    assert found.confidence is not None
    threshold = float(np.median(found.confidence))
    strict = Segmenter(weights=str(out), confidence_threshold=threshold)
    strict.setup()
    doubtful = strict.process(large)
    assert doubtful.confidence is None
    np.testing.assert_array_equal(doubtful.classes == VOID, found.confidence < threshold)

    sure_walls = Segmenter(weights=str(out), class_thresholds={"wall": threshold})
    sure_walls.setup()
    np.testing.assert_array_equal(
        sure_walls.process(large).classes == VOID, (found.confidence < threshold) & (found.classes == 0)
    )
    with pytest.raises(
        ModelError, match=r"class_thresholds has 'walls': 0\.5; it takes shares from 0 to 1 for wall, fl"
    ):
        Segmenter(weights=str(out), class_thresholds={"walls": 0.5}).setup()


def test_the_file_computes_the_class_and_its_probability(tmp_path: Path) -> None:
    from operators.weights import open_network

    torch.manual_seed(1)
    network = SegmentationNetwork(4, width=0.25).eval()
    facts = {"kind": "segmenter", "classes": list("abcd"), "width": 64, "height": 48}
    file = tmp_path / "n.onnx"
    export_network(DeployedSegmenter(network, (48, 64)), (64, 48), ["classes", "confidence"], facts, file)
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    classes, confidence = open_network(file, "segmenter").run(pixels)
    with torch.inference_mode():
        scores = network(torch.from_numpy(pixels.transpose(2, 0, 1)[None].astype(np.float32) / 255))
        best = scores.softmax(dim=1).amax(dim=1, keepdim=True)
        label, best = enlarged(scores, (48, 64)).argmax(dim=1), enlarged(best, (48, 64))[:, 0]
    assert (classes == label.numpy()).mean() > 0.995
    np.testing.assert_allclose(confidence, best.numpy(), atol=5e-3)


def test_enlarging_keeps_each_cell_at_the_pixel_that_it_learns_from() -> None:
    maps = torch.rand(1, 2, 5, 7, generator=torch.Generator().manual_seed(0))
    large = enlarged(maps, (10, 14))
    assert torch.equal(large[:, :, ::2, ::2], maps)
    torch.testing.assert_close(large[0, 0, 1, 2], (maps[0, 0, 0, 1] + maps[0, 0, 1, 1]) / 2)


def test_letterboxed_images_get_a_map_of_the_image_shape(tmp_path: Path) -> None:
    network = SegmentationNetwork(3, width=0.25)
    facts = {"kind": "segmenter", "classes": list("abc"), "width": 64, "height": 48}
    file = tmp_path / "n.onnx"
    export_network(DeployedSegmenter(network, (48, 64)), (64, 48), ["classes", "confidence"], facts, file)
    made = Segmenter(weights=str(file))
    made.setup()
    for shape in ((30, 100), (100, 30), (48, 64), (31, 17)):
        found = made.process(Image(stamp=1, frame="camera", data=np.zeros(shape, np.uint8)))
        assert found.classes.shape == shape


def test_a_network_with_other_outputs_is_refused(tmp_path: Path) -> None:
    facts = {"kind": "segmenter", "classes": list("abc"), "width": 64, "height": 48}
    file = tmp_path / "n.onnx"
    export_network(SegmentationNetwork(3, width=0.25), (64, 48), ["scores"], facts, file)
    with pytest.raises(NetworkFileError, match="or 8-bit scores; has scores tensor"):
        Segmenter(weights=str(file)).setup()
    with pytest.raises(FileNotFoundError, match="looked for"):
        Segmenter(weights=str(tmp_path / "none.onnx")).setup()


# ---- data


@pytest.mark.parametrize(
    ("mask", "fault"),
    [
        (np.full((96, 128), 3, np.uint8), r"003\.png: class id 3 in 12288 pixels; there are 3 classes \(0 to 2\)"),
        (np.zeros((96, 100), np.uint8), r"003\.png is 100x96, its image .*003\.jpg is not"),
        (np.zeros((96, 128, 3), np.uint8), r"003\.png is uint8\[96, 128, 3\]; a mask is an 8-bit grey PNG"),
    ],
)
def test_a_bad_mask_is_named(tmp_path: Path, mask: np.ndarray, fault: str) -> None:
    write_folder(tmp_path, 4)
    cv2.imwrite(str(tmp_path / "masks" / "003.png"), mask)
    data = read_segmentation_data(tmp_path)
    (bad,) = (image for image in (*data.training, *data.validation) if image.mask.stem == "003")
    with pytest.raises(DataError, match=fault):
        bad.read(3)


def test_a_folder_that_is_not_complete_is_explained(tmp_path: Path) -> None:
    write_folder(tmp_path, 3)
    (tmp_path / "masks" / "001.png").unlink()
    with pytest.raises(DataError, match=r"no mask .*001\.png for the image 001\.jpg"):
        read_segmentation_data(tmp_path)
    (tmp_path / "classes.txt").unlink()
    with pytest.raises(DataError, match=r"has no classes\.txt"):
        read_segmentation_data(tmp_path)


def test_listed_validation_images_are_kept_apart(tmp_path: Path) -> None:
    (write_folder(tmp_path, 5) / "val.txt").write_text("001.jpg\n004.jpg\n")
    data = read_segmentation_data(tmp_path)
    assert [image.image.name for image in data.validation] == ["001.jpg", "004.jpg"]
    assert len(data.training) == 3
    (tmp_path / "val.txt").write_text("009.jpg\n")
    with pytest.raises(DataError, match=r"names '009\.jpg', which is not in images/"):
        read_segmentation_data(tmp_path)


# ---- loss and score


def test_rare_classes_weigh_more_but_not_without_bound(tmp_path: Path) -> None:
    data = read_segmentation_data(write_folder(tmp_path, 10))
    weights = class_weights(data)
    assert weights[2] > weights[0]
    assert float(weights.max() / weights.min()) <= 4.001


def test_dice_is_none_for_the_right_answer_and_blind_to_void() -> None:
    mask = torch.randint(0, 3, (1, 8, 8), generator=torch.Generator().manual_seed(0))
    right = torch.nn.functional.one_hot(mask, 3).permute(0, 3, 1, 2).float() * 40
    assert dice_loss(right, mask).item() < 0.01
    assert dice_loss(-right, mask).item() > 0.6
    void = mask.clone()
    void[:, :4] = VOID
    changed = right.clone()
    changed[:, :, :4] = -right[:, :, :4]
    assert dice_loss(changed, void).item() == pytest.approx(dice_loss(right, void).item())
    assert dice_loss(right, torch.full_like(mask, VOID)).item() == 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5))
def test_iou_is_that_of_the_sets_of_pixels(seed: int, classes: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, classes + 1, (6, 7)).astype(np.uint8)
    truth[truth == classes] = VOID
    found = rng.integers(0, classes + 1, (6, 7)).astype(np.uint8)
    table = confusion(truth, found, classes)
    expected = []
    for k in range(classes):
        known = truth != VOID
        union = ((truth == k) | (found == k)) & known
        hit = (truth == k) & (found == k)
        expected.append(hit.sum() / union.sum() if (truth == k).any() else np.nan)
    np.testing.assert_allclose(class_iou(table), expected)
    assert mean_iou(table) == pytest.approx(np.nanmean(expected) if np.isfinite(expected).any() else 0)
