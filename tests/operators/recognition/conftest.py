"""A classifier that the training command made of pictures of three shapes."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from made_pictures import SHAPES, picture
from typer.testing import CliRunner


@pytest.fixture(scope="session")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shapes")
    for label, shape in enumerate(SHAPES):
        (folder / shape).mkdir()
        for i in range(24):
            cv2.imwrite(str(folder / shape / f"{i:02d}.png"), picture(shape, 100 * label + i)[..., ::-1])
    return folder


def trained(shapes: Path, folder: Path, epochs: int) -> Path:
    """Returns what the command makes of the shapes in some epochs."""
    pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.training.commands import train

    out = folder / "shapes.onnx"
    words = ["classifier", str(shapes), "--out", str(out), "--size", "64x64", "--epochs", str(epochs)]
    words += ["--variation", "0.3", "--threads", "1", "--workers", "1", "--evaluate-every", "7"]
    done = CliRunner().invoke(train, words)
    assert done.exit_code == 0, done.output
    assert "operators.recognition:ImageClassifier" in done.output
    return out


@pytest.fixture(scope="session")
def classifier(shapes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that has hardly learned anything."""
    return trained(shapes, tmp_path_factory.mktemp("trained"), 1)


@pytest.fixture(scope="session")
def good_classifier(shapes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that tells the shapes apart, for long tests."""
    return trained(shapes, tmp_path_factory.mktemp("trained"), 14)
