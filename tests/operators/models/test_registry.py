"""The rows of the registry, and those of a user's own file."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from operators.detection.coco import CLASS_LISTS
from operators.detection.decoders import LAYOUTS
from operators.detection.keypoint_detector import KEYPOINT_LAYOUTS
from operators.inference import ModelError
from operators.models.registry import Model, Registry

ROW = """
models:
  crates:
    about: crates and pallets
    task: detection
    operator: operators.detection:OnnxDetector
    params: {decoder: yolov8}
    classes: [crate, pallet]
    input: 64x64 RGB
    licence: {code: MIT, weights: MIT}
    home: nowhere
    source: {url: "http://127.0.0.1/crates.onnx"}
    sha256: "0000000000000000000000000000000000000000000000000000000000000000"
    published: nothing
"""


@pytest.fixture
def named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A registry file that the environment names."""
    file = tmp_path / "mine.yaml"
    file.write_text(ROW)
    monkeypatch.setenv("DATAFLOW_MODELS", str(file))
    return file


@pytest.mark.parametrize("model", list(Registry.load()), ids=lambda model: model.name)
def test_every_row_fits_its_operator(model: Model) -> None:
    module, _, name = model.operator.partition(":")
    operator = getattr(import_module(module), name)
    fields = operator.spec.parameters.model_fields
    given = {name for name, field in fields.items() if field.default is None or model.source.torchvision is not None}
    assert model.params.keys() <= given
    if "decoder" in model.params:
        assert model.params["decoder"] in (*LAYOUTS, *KEYPOINT_LAYOUTS, "grid")
    if isinstance(model.classes, str):
        assert model.classes in CLASS_LISTS
    assert model.licence.code
    assert model.licence.weights


def test_a_file_of_ones_own_adds_rows_and_hides_those_of_the_same_name(named: Path) -> None:
    named.write_text(ROW.replace("crates:", "yolox_nano:"))
    registry = Registry.load.__func__(Registry)
    assert registry["yolox_nano"].about == "crates and pallets"
    assert "yolox_tiny" in registry


def test_the_row_in_the_documentation_is_one(repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "models.md").read_text(encoding="utf-8")
    file = tmp_path / "documented.yaml"
    file.write_text(page.partition("```yaml\nmodels:")[2].partition("```")[0].join(("models:", "")))
    assert Registry([file])["crates"].classes == ["crate", "pallet"]


def test_a_name_that_is_not_there_is_answered_with_the_nearest() -> None:
    with pytest.raises(ModelError, match=r"there is no model 'yolox_nan'; did you mean 'yolox_nano'\?"):
        Registry.load()["yolox_nan"]


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("task: detection", "task: dancing", r"mine\.yaml: models\.crates: task: "),
        ('    sha256: "' + "0" * 64 + '"\n', "", "sha256 must be given for a file that is downloaded"),
        ("http://127.0.0.1/crates.onnx", "ftp://somewhere", "url must begin with https://"),
        ("    published: nothing\n", "", "published: Field required"),
        ("models:", "networks:", "it must hold `models:`"),
        (
            "    published: nothing\n",
            "    published: nothing\n    parts: {text: {source: {url: file:///t.onnx}}}\n",
            "sha256 must be given for a file that is downloaded",
        ),
        ("    published: nothing\n", "    published: nothing\n    parts: {voice: {}}\n", "parts.voice"),
        ("{url:", "{torchvision: COCO_V1, url:", "one of url, index with package and member"),
    ],
)
def test_a_faulty_row_is_named_with_its_fault(named: Path, old: str, new: str, reason: str) -> None:
    assert old in ROW
    named.write_text(ROW.replace(old, new))
    with pytest.raises(ModelError, match=reason):
        Registry([named])


def test_a_file_is_known_by_its_digest_whatever_its_name() -> None:
    registry = Registry.load()
    row = registry["yolox_nano"]
    assert row.sha256 is not None
    assert registry.with_digest(row.sha256) == registry.with_digest(row.exports[0]) == row
    assert registry.with_digest("1" * 64) is None


def test_part_of_a_model_is_a_row_with_its_file() -> None:
    registry = Registry.load()
    model = registry["clip_vit_b32"]
    text = registry["clip_vit_b32.text"]
    assert text == model.part("text")
    assert [each.file.name for each in model.files] == [
        "clip_vit_b32.onnx", "clip_vit_b32.text.onnx", "clip_vit_b32.tokenizer.gz"
    ]  # fmt: skip
    assert text.accepts(str(model.parts["text"].sha256))
    assert not text.accepts(str(model.sha256))
    with pytest.raises(ModelError, match="row yolox_nano has no text among its parts"):
        registry["yolox_nano"].part("text")
    with pytest.raises(ModelError, match=r"there is no model 'clip_vit_b32\.voice'; did you mean 'clip_vit_b32"):
        registry["clip_vit_b32.voice"]
