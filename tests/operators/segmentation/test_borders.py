"""The second look at the borders of classes: where it looks, what it decides, how it is trained, and its files."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interrupted import trained_twice
from numpy.typing import NDArray

from dataflow.messages import Image
from operators.image.letterbox import ImageFit
from operators.learning.augmentation import Variation
from operators.segmentation import Segmenter
from operators.segmentation.borders import BLOCK, Blocks, best_cells, found_blocks, look_again, worked
from operators.segmentation.dataset import VOID, MaskedImage, SegmentationData
from operators.training.options import ImageTraining
from operators.training.refining import add_second
from operators.weights import NetworkFileError, open_network

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.learning.export import attach_second, export_network, without_second
    from operators.learning.files import TrainingFileError
    from operators.learning.loop import Settings, train
    from operators.segmentation.border_training import BorderTask
    from operators.segmentation.network import DeployedSegmenter, ScoringSegmenter, SegmentationNetwork
    from operators.segmentation.training import SegmenterTask
    from operators.training.quantization import quantize_network

CLASSES = ("wall", "floor", "ball")
COLORS = np.array([[170, 160, 150], [90, 70, 50], [40, 90, 210]], np.uint8)
GENTLE = Variation(flip=0.5, scale=1.2, shift=0.1, color=0.1, noise=4, blur=0)
SIZE = (256, 192)
Pixels = NDArray[np.uint8]


def scene(seed: int) -> tuple[Pixels, Pixels]:
    """A noisy image of a wall above a floor whose border leans, with two balls, and its mask."""
    rng = np.random.default_rng(seed)
    mask = np.zeros(SIZE[::-1], np.uint8)
    left, right = (int(rng.integers(70, 150)) for _ in range(2))
    cv2.fillPoly(mask, [np.array([[0, left], [SIZE[0], right], [SIZE[0], SIZE[1]], [0, SIZE[1]]])], 1)
    for _ in range(2):
        at = int(rng.integers(30, 226)), int(rng.integers(30, 162))
        cv2.circle(mask, at, int(rng.integers(8, 25)), 2, -1)
    noise = rng.normal(0, 6, (*SIZE[::-1], 3))
    return np.clip(COLORS[mask] + noise, 0, 255).astype(np.uint8), mask


def data_of(folder: Path, training: int, validation: int) -> SegmentationData:
    folder.mkdir()
    images = []
    for k in range(training + validation):
        pixels, mask = scene(k)
        cv2.imwrite(str(folder / f"{k:03d}.png"), pixels[..., ::-1])
        cv2.imwrite(str(folder / f"m{k:03d}.png"), mask)
        images.append(MaskedImage(folder / f"{k:03d}.png", folder / f"m{k:03d}.png"))
    return SegmentationData(CLASSES, tuple(images[:training]), tuple(images[training:]))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, SegmentationData]:
    """A segmenter of small input that has learned a little, the same with a second look, and their data."""
    folder = tmp_path_factory.mktemp("borders")
    data, plain, out = data_of(folder / "data", 16, 4), folder / "plain.onnx", folder / "finer.onnx"
    task = SegmenterTask(data, (96, 80), width=0.25, variation=GENTLE)  # 96x72 of it are the image
    train(task, Settings(epochs=12, batch=4, learning_rate=5e-3, threads=1, evaluate_every=12), plain)
    own = ImageTraining(epochs=16, batch=4, learning_rate=4e-3, threads=1, evaluate_every=16, json=True)
    outcome = add_second(BorderTask(data, plain, variation=GENTLE), plain, out, own)
    assert outcome.best["miou"] > outcome.best["miou_before"]
    return plain, out, data


def coarse_scores(mask: Pixels, cells: tuple[int, int]) -> Pixels:
    """Scores (C, h, w) as a segmenter without fault might give them: shares of the classes in each cell."""
    shares = [cv2.resize((mask == k).astype(np.float32), cells, interpolation=cv2.INTER_AREA) for k in range(3)]
    return np.rint(np.stack(shares) * 200).astype(np.uint8)


def tiles(mask: Pixels, blocks: Blocks) -> Pixels:
    """The true classes (N, 16) of blocks of an image whose sides are multiples of a block's."""
    parts = mask.reshape(mask.shape[0] // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
    return parts[blocks.at[:, 1], blocks.at[:, 0]].reshape(-1, BLOCK * BLOCK)


def true_sides(mask: Pixels, blocks: Blocks) -> NDArray[np.float32]:
    """The right answer to blocks."""
    return (tiles(mask, blocks) == blocks.first[:, None]) - np.float32(0.5)


# ---- where it looks


def test_every_block_with_two_classes_is_looked_at_and_shows_its_pixels() -> None:
    pixels, mask = scene(3)
    fit = ImageFit.plan("letterbox", SIZE, (192, 144))
    shown, placed = worked(pixels, fit)
    scores = coarse_scores(mask, (96, 72))
    coarse, blocks = found_blocks(scores, 0.1, *best_cells(scores), shown, placed)
    assert coarse.shape == mask.shape
    parts = mask.reshape(mask.shape[0] // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
    divided = {(int(x), int(y)) for y, x in np.argwhere(parts.min(axis=(2, 3)) != parts.max(axis=(2, 3)))}
    looked = {(int(x), int(y)) for x, y in blocks.at}
    assert len(divided) > 50
    assert len(divided - looked) < 0.05 * len(divided)
    assert len(looked) < 0.35 * parts.shape[0] * parts.shape[1]
    inner = blocks.pixels[:, 4:8, 4:8]
    for (x, y), seen in zip(blocks.at, inner, strict=True):
        assert np.array_equal(seen, pixels[4 * y : 4 * y + 4, 4 * x : 4 * x + 4])


def test_preferences_lie_where_the_pixels_are() -> None:
    """The border of a left and a right half: a straight line in the preferences, at its true place."""
    mask = np.zeros((96, 128), np.uint8)
    mask[:, 61:] = 1
    pixels = COLORS[mask]
    fit = ImageFit.plan("letterbox", (128, 96), (128, 96))
    scores = np.stack([200 - mask[::2, ::2] * 100, 100 + mask[::2, ::2] * 100]).astype(np.uint8)
    shown, placed = worked(pixels, fit)
    _, blocks = found_blocks(scores, 0.1, *best_cells(scores), shown, placed)
    for k, (x, _) in enumerate(blocks.at):
        at = 4 * x - 4 + 2 * np.arange(6) + 0.5  # pixels at the samples of a row
        cell = at / 2 - 0.25 + 0.25 - 0.0  # pixel 2i of the input, whose middle is 2i, has the scores of cell i
        lean = 10 - 20 * np.clip(cell - 30, 0, 1)  # cells up to 30 are of the first class, from 31 of the second
        sign = 1 if blocks.first[k] == 0 else -1
        assert np.allclose(blocks.preferences[k, 2], sign * lean, atol=0.4)


def test_a_block_at_the_images_border_is_whole() -> None:
    pixels, mask = scene(4)
    pixels, mask = pixels[:187, :251], mask[:187, :251]  # not a multiple of a block
    fit = ImageFit.plan("letterbox", (251, 187), (192, 144))
    scores = coarse_scores(mask, (96, 72))
    found = look_again(lambda blocks: np.ones((len(blocks.at), 16), np.float32), scores, 0.1, pixels, fit)
    assert found.shape == mask.shape


@given(st.integers(1, 90), st.integers(1, 90), st.integers(0, 5))
@settings(max_examples=30, deadline=None)
def test_images_of_any_size_get_classes_of_theirs(width: int, height: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    fit = ImageFit.plan("letterbox", (width, height), (32, 32))
    scores = rng.integers(0, 256, (4, 16, 16)).astype(np.uint8)
    pixels = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    sides = rng.normal(size=(10_000, 16)).astype(np.float32)
    found = look_again(lambda blocks: sides[: len(blocks.at)], scores, 0.1, pixels, fit)
    assert found.shape == (height, width)
    assert found.max() < 4


# ---- what it decides


def test_right_answers_give_the_true_mask_but_for_third_classes() -> None:
    for seed in range(5):
        pixels, mask = scene(seed)
        fit = ImageFit.plan("letterbox", SIZE, (192, 144))
        scores = coarse_scores(mask, (96, 72))
        found = look_again(partial(true_sides, mask), scores, 0.1, pixels, fit)
        assert (found != mask).mean() < 0.002
        coarse = look_again(lambda b: np.ones((len(b.at), 16), np.float32), scores, 0.1, pixels, fit)
        assert (coarse != mask).mean() > 0.01


def test_one_class_alone_needs_no_second_look() -> None:
    scores = np.zeros((3, 48, 64), np.uint8)
    scores[1] = 9

    def never(blocks: Blocks) -> NDArray[np.float32]:
        raise AssertionError

    found = look_again(
        never, scores, 0.1, np.zeros((96, 128, 3), np.uint8), ImageFit.plan("letterbox", (128, 96), (128, 96))
    )
    assert (found == 1).all()


def test_of_equal_scores_the_first_class_is_the_best() -> None:
    scores = np.random.default_rng(0).integers(0, 4, (5, 20, 30)).astype(np.uint8)
    labels, best = best_cells(scores)
    assert np.array_equal(labels, scores.argmax(axis=0))
    assert np.array_equal(best, scores.max(axis=0))


# ---- the operator and its files


@pytest.mark.long
def test_it_finds_borders_better_than_the_first_look(files: tuple[Path, Path, SegmentationData]) -> None:
    plain, finer, _ = files
    wrong = []
    for file in (plain, finer):
        segmenter = Segmenter(weights=str(file))
        segmenter.setup()
        missed = 0.0
        for seed in range(700, 708):
            pixels, mask = scene(seed)
            found = segmenter.process(Image(stamp=seed, frame="camera", data=pixels))
            missed += float((found.classes != mask).mean())
        wrong.append(missed / 8)
    assert wrong[1] < 0.75 * wrong[0]


@pytest.mark.long
def test_it_repeats_itself_and_confidence_stays(files: tuple[Path, Path, SegmentationData]) -> None:
    plain, finer, _ = files
    image = Image(stamp=1, frame="camera", data=scene(800)[0])
    made = [Segmenter(weights=str(file), with_confidence=True) for file in (plain, finer, finer)]
    for each in made:
        each.setup()
    first, second, again = (each.process(image) for each in made)
    assert second.digest() == again.digest()
    assert first.confidence is not None
    assert second.confidence is not None
    assert np.array_equal(first.confidence, second.confidence)
    strict = Segmenter(weights=str(finer), confidence_threshold=float(np.median(second.confidence)))
    strict.setup()
    assert np.array_equal(strict.process(image).classes == VOID, second.confidence < np.median(second.confidence))


@pytest.mark.long
def test_8_bits_leave_it_in_the_file(files: tuple[Path, Path, SegmentationData], tmp_path: Path) -> None:
    plain, finer, data = files
    small, smaller = tmp_path / "small.onnx", tmp_path / "smaller.onnx"
    for file, out in ((finer, small), (plain, smaller)):
        quantize_network(file, [image.pixels() for image in data.training[:4]], out)
    assert without_second(small) == without_second(smaller)
    made = [Segmenter(weights=str(file)) for file in (finer, small)]
    for each in made:
        each.setup()
    image = Image(stamp=1, frame="camera", data=scene(801)[0])
    first, second = (each.process(image).classes for each in made)
    assert (first == second).mean() > 0.97


@pytest.mark.long
def test_a_second_network_that_does_not_fit_is_refused(
    files: tuple[Path, Path, SegmentationData], tmp_path: Path
) -> None:
    plain, _, _ = files
    attach_second(plain, plain, tmp_path / "twice.onnx")
    with pytest.raises(
        NetworkFileError, match=r"must be of the kind borders and of the classes .* it is of the kind segmenter"
    ):
        Segmenter(weights=str(tmp_path / "twice.onnx")).setup()


# ---- training


@pytest.mark.long
def test_a_segmenter_without_scores_or_of_other_classes_is_refused(
    files: tuple[Path, Path, SegmentationData], tmp_path: Path
) -> None:
    plain, _, data = files
    network = SegmentationNetwork(3, width=0.25).eval()
    facts = {"kind": "segmenter", "classes": list(CLASSES), "width": 96, "height": 80}
    old = tmp_path / "old.onnx"
    export_network(DeployedSegmenter(network, (80, 96)), (96, 80), ["classes", "confidence"], facts, old)
    with pytest.raises(TrainingFileError, match="gives no scores to look at again"):
        BorderTask(data, old)
    other = SegmentationData(("wall", "floor", "cube"), data.training, data.validation)
    with pytest.raises(TrainingFileError, match="has wall, floor, ball; the data have wall, floor, cube"):
        BorderTask(other, plain)


def test_the_scores_in_the_file_are_those_of_the_network(tmp_path: Path) -> None:
    torch.manual_seed(2)
    network = SegmentationNetwork(4, width=0.25).eval()
    facts = {"kind": "segmenter", "classes": list("abcd"), "width": 64, "height": 48, "score_step": 0.06}
    export_network(ScoringSegmenter(network, 0.06), (64, 48), ["scores"], facts, tmp_path / "n.onnx")
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    (scores,) = open_network(tmp_path / "n.onnx", "segmenter").run(pixels)
    with torch.inference_mode():
        theirs = network(torch.from_numpy(pixels.transpose(2, 0, 1)[None].astype(np.float32) / 255)).numpy()
    below = (scores.astype(np.float32) - 255) * 0.06
    assert np.abs(below - (theirs - theirs.max(axis=1, keepdims=True))).max() < 0.06


@pytest.mark.long
def test_an_interrupted_training_ends_with_the_same_bits(
    files: tuple[Path, Path, SegmentationData], tmp_path: Path
) -> None:
    plain, _, data = files
    few = SegmentationData(data.classes, data.training[:3], data.validation[:1])
    own = Settings(epochs=2, batch=4, threads=1)
    trained_twice(lambda: BorderTask(few, plain, variation=GENTLE), own, tmp_path)
