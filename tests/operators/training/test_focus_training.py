"""The focus network: views of simulated worlds, what each cell should say, training and files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from operators.detection.focus.model import FocusModel
from operators.detection.focus.targets import NOTHING, UNKNOWN, targets
from operators.detection.focus.views import CLASSES, MOST, NONE, Views
from operators.detection.nms import intersection_over_union
from operators.simulator.worlds import INDOOR
from operators.training import simulated_views
from operators.training.made_worlds import file_of, worlds
from operators.weights import NetworkFileError

pytest.importorskip("torch", reason="training needs the extra [train]")

from operators.detection.focus.training import FocusTask
from operators.training.commands import train

U8 = NDArray[np.uint8]
BALL, BOOK = CLASSES.index("ball"), CLASSES.index("book")
COLORS = {BALL: (210, 60, 40), BOOK: (40, 90, 210)}
SIDE = 128


def shelf(seed: int) -> tuple[U8, U8, U8]:
    """A grey view of three blue books side by side, with a dark line between them, and a red ball, somewhere."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(100, 140, (SIDE, SIDE, 3)).astype(np.uint8)
    owners, classes = np.zeros((SIDE, SIDE), np.uint8), np.full(MOST, NONE, np.uint8)
    x, y = rng.integers(20, 60, 2).tolist()
    things = [(BOOK, x + 14 * k, y, 13, 30) for k in range(3)] + [(BALL, x, y + 38, 16, 16)]
    for k, (of, left, top, width, height) in enumerate(things):
        pixels[top : top + height, left : left + width] = COLORS[of]
        pixels[top : top + height, left + width] = 20
        owners[top : top + height, left : left + width], classes[k] = k + 1, of
    return pixels, owners, classes


def shelves(seeds: range) -> Views:
    return Views(*(np.stack(part) for part in zip(*map(shelf, seeds), strict=True)))


def test_each_cell_knows_its_thing_and_where_that_ends() -> None:
    _, owners, classes = shelf(0)
    owners[100:102, 100:102], classes[4] = 5, BALL  # one cell: too little to be found
    labels, sides, weights = targets(owners, classes)
    row, column = (int(each[0]) for each in np.nonzero(owners == 2))
    at = row // 2 + 1, column // 2 + 1
    assert labels[at] == BOOK
    assert sides[:, at[0], at[1]].tolist() == [column, row, column + 13, row + 30]
    for of in (1, 2, 3, 4):
        np.testing.assert_allclose(np.square(weights[owners[1::2, 1::2] == of]).sum(), 1, rtol=1e-5)
    assert labels[50, 50] == UNKNOWN
    assert labels[0, 0] == NOTHING


def test_it_is_trained_scored_and_written_and_tells_neighbours_apart(tmp_path: Path) -> None:
    folder, out = tmp_path / "views", tmp_path / "focus.onnx"
    folder.mkdir()
    for k, world in enumerate(worlds(simulated_views.TRAINING, 2, INDOOR)):
        shelves(range(64 * k, 64 * k + 64)).write(file_of(folder, world))
    shelves(range(1000, 1008)).write(file_of(folder, worlds(simulated_views.VALIDATION, 1, INDOOR)[0]))
    words = ["focus", str(folder), "--out", str(out), "--worlds", "2", "--validation", "1", "--epochs", "7",
             "--batch", "8", "--evaluate-every", "7"]  # fmt: skip
    done = CliRunner().invoke(train, [*words, "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["scores"]["ap50_book"] > 0.5

    model = FocusModel.open(out)
    pixels, owners, _ = shelf(2000)
    found = model.found(pixels, [(0, 0, SIDE, SIDE)], 0.2, 0.5, 20)
    for k in (1, 2, 3):
        rows, columns = np.nonzero(owners == k)
        box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float32)
        assert intersection_over_union(box, found.boxes[found.classes == BOOK]).max() > 0.5
    alone = model.found(pixels[:112, :96].copy(), [(0, 0, 96, 112)], 0.2, 0.5, 20)  # any size
    assert len(alone.boxes)


def test_simulated_views_tell_what_each_pixel_is_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated_views, "_VIEWS", 6)
    first, again = (simulated_views.seen_in("table_top", 45_701, 2) for _ in range(2))
    assert first.images.tobytes() == again.images.tobytes()
    assert first.images.shape == (6, SIDE, SIDE, 3)
    assert first.images.std(axis=(1, 2, 3)).min() > 5
    for owners, classes in zip(first.owners, first.classes, strict=True):
        told = classes[classes != NONE]
        assert len(told)
        assert told.max() < len(CLASSES)
        assert set(np.unique(owners)) - {0} == set(range(1, len(told) + 1))
        sizes = np.bincount(owners.ravel(), minlength=len(told) + 1)[1:]
        assert (np.diff(sizes) <= 0).all()
    assert (first.classes == BOOK).any()


def test_networks_of_other_cells_and_files_without_views_are_refused(tmp_path: Path) -> None:
    file, views = tmp_path / "other.onnx", shelves(range(2))
    task = FocusTask(views, views)
    task.export(task.network.eval(), {"stride": 4}, file)
    with pytest.raises(NetworkFileError, match="is made for stride 4, multiple 16, not stride 2, multiple 16"):
        FocusModel.open(file)
    np.savez(tmp_path / "foreign.npz", images=views.images)
    with pytest.raises(ValueError, match=r"foreign.npz holds no classes, owners: delete it"):
        Views.read(tmp_path / "foreign.npz")
