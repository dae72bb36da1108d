"""Every option of `train`, `evaluate`, `learn`, `models` and `scene` is accepted and used once, on tiny data."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from cli_commands import commands, untried
from made_pictures import picture
from typer.testing import CliRunner

from dataflow.cli.main import app

ALL = (
    "--epochs 1 --batch 4 --learning-rate 1e-3 --seed 1 --evaluate-every 1 --workers 1 --threads 1 --device cpu --json"
)
IMAGES = f"{ALL} --flip --variation 0.1 --bfloat16"
SMALL = "--size 64x48 --width 0.25"

TRIED: tuple[str, ...] = (
    f"train pair DATA --out OUT/pair {SMALL} --refiner-epochs 1 --border-epochs 1 {IMAGES} --overwrite",
    f"train pair DATA --out OUT/pair {SMALL} --refiner-epochs 0 --border-epochs 0 {IMAGES} --resume",
    f"train pair DATA --out OUT/more {SMALL} --refiner-epochs 0 --border-epochs 0 {IMAGES} --from OUT/pair/pair.pt",
    f"train refiner OUT/pair/detector.onnx DATA --out OUT/r.onnx {IMAGES} --overwrite",
    f"train refiner OUT/pair/detector.onnx DATA --out OUT/r.onnx {IMAGES} --resume",
    f"train borders OUT/pair/segmenter.onnx DATA --out OUT/b.onnx {IMAGES} --overwrite",
    f"train borders OUT/pair/segmenter.onnx DATA --out OUT/b.onnx {IMAGES} --resume",
    "train quantize OUT/pair/detector.onnx DATA --out OUT/d8.onnx --images 2 --seed 1 --json --overwrite",
    "train quantize OUT/pair/segmenter.onnx DATA --out OUT/s8.onnx --images 2",
    "train trunk OUT/d8.onnx OUT/s8.onnx --out OUT/trunk --overwrite",
    "evaluate detector DATA --weights OUT/pair/detector.onnx --all --seed 1 --json",
    "evaluate segmenter DATA --weights OUT/pair/segmenter.onnx --all --seed 1 --json",
    f"train detector DATA --classes chair,table --out OUT/d.onnx {SMALL} --from OUT/pair/pair.pt --refiner-epochs 0"
    f" {IMAGES} --overwrite",
    f"train detector DATA --classes chair,table --out OUT/d.onnx {SMALL} --from OUT/pair/pair.pt --refiner-epochs 0"
    f" {IMAGES} --resume",
    f"train detector DATA --out OUT/e.onnx {SMALL} --refiner-epochs 0 {IMAGES} --backbone-weights OUT/d.pt"
    " --frozen-stride 4",
    f"train segmenter DATA --out OUT/s.onnx {SMALL} --from OUT/pair/pair.pt --border-epochs 0 {IMAGES} --overwrite",
    f"train segmenter DATA --out OUT/s.onnx {SMALL} --from OUT/pair/pair.pt --border-epochs 0 {IMAGES} --resume",
    f"train segmenter DATA --out OUT/t.onnx {SMALL} --border-epochs 0 {IMAGES} --backbone-weights OUT/s.pt"
    " --frozen-stride 4",
    f"train classifier CLASSES --out OUT/c.onnx --size 32x32 --residual {IMAGES} --overwrite",
    f"train classifier CLASSES --out OUT/c.onnx --size 32x32 --residual {IMAGES} --resume",
    f"train classifier CLASSES --out OUT/f.onnx --size 32x32 --residual {IMAGES} --from OUT/c.pt",
    "learn object chair DATA --out OUT/chair.npz --weights OUT/pair/detector.onnx --background CLASSES/disc --seed 1"
    " --json --overwrite",
    "evaluate graph synthetic_rgbd --set frames=3 --all --json",
    "scene SCENE --at 0.5 --query shelf --json --export OUT/scene.json --overwrite",
    "scene SCENE --nodes --stream scene/graph",
    "scene SCENE --history self",
    "models list --task detection --json",
    "models show simulated --json",
    "models check simulated --json",
)
"""Commands as they are typed, in an order in which later ones use the files of earlier ones."""

ELSEWHERE: dict[str, tuple[str, str]] = {
    "calibrate camera": ("*", "test_calibrate_commands.py has boards"),
    "calibrate stereo": ("*", "the same"),
    "calibrate camera-imu": ("*", "the same"),
    "train activity": ("*", "test_people_training.py has episodes"),
    "train posture": ("*", "test_people_training.py has silhouettes"),
    "train torchvision": ("*", "test_torchvision_training.py: another library"),
    "evaluate graph": ("--data", "test_graph_evaluation.py has recordings"),
    "models get": ("--from --json", "tests/operators/models has a server"),
}


@pytest.fixture(scope="module")
def classes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("classes")
    for shape in ("cross", "disc"):
        (folder / shape).mkdir()
        for seed in range(6):
            cv2.imwrite(str(folder / shape / f"{seed}.png"), picture(shape, seed))
    return folder


def _placed(word: str, places: dict[str, Path]) -> str:
    first, _, rest = word.partition("/")
    return str(places[first] / rest) if first in places else word


@pytest.mark.long
def test_commands_take_their_options(worlds: Path, classes: Path, repository: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="training needs the extra [train]")
    places = {
        "DATA": worlds,
        "CLASSES": classes,
        "OUT": tmp_path,
        "SCENE": repository / "tests" / "recordings_of" / "perception.mcap",
    }
    for line in TRIED:
        done = CliRunner().invoke(app, [_placed(word, places) for word in line.split()])

        assert done.exit_code == 0, f"{line}\n{done.output}\n{done.exception!r}"


def test_every_option_of_commands_of_other_packages_is_tried() -> None:
    assert untried(commands(built_in=False), TRIED, ELSEWHERE) == {}


@pytest.mark.long
def test_training_with_other_layers_frozen_is_not_resumed(worlds: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="training needs the extra [train]")
    words = f"train segmenter {worlds} --out {tmp_path / 's.onnx'} {SMALL} --border-epochs 0 {ALL}".split()
    assert CliRunner().invoke(app, words).exit_code == 0

    done = CliRunner().invoke(app, [*words, "--resume", "--from", str(tmp_path / "s.pt")])

    assert done.exit_code == 2
    assert "other layers were frozen" in " ".join(done.output.split())
