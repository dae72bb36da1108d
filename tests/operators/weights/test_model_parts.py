"""Parts of models: together they compute what the whole does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from made_onnx import node, onnx_model
from numpy.typing import NDArray

from operators.inference import open_content
from operators.weights.model_parts import ModelParts, Value

pytest.importorskip("onnx", reason="models are made with the extra [train]")


def model(weight: float = 2.0, words: str = "", operation: str = "Add") -> bytes:
    """image → middle = weight x image, side = middle + 1 → answer = relu(middle) + side; `words` end inner names."""
    nodes = [
        node("Mul", f"image weight{words}", f"middle{words}"),
        node(operation, f"middle{words} one{words}", f"side{words}"),
        node("Relu", f"middle{words}", f"positive{words}"),
        node("Add", f"positive{words} side{words}", "answer"),
    ]
    values = {f"weight{words}": np.float32(weight), f"one{words}": np.float32(1)}
    made = onnx_model(nodes, {"image": [1, 3]}, {"answer": [1, 3]}, values, {"key": "kept"})
    content: bytes = made.SerializeToString()
    return content


def run(content: bytes, given: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    found: list[NDArray[np.float32]] = open_content(content, "the part").run(None, given)
    return found


def values(names: Sequence[str]) -> list[Value]:
    return [Value(name, "tensor(float)", (1, 3)) for name in names]


IMAGE = np.array([[-1.5, 0.0, 4.0]], np.float32)


def test_a_part_before_and_a_part_after_compute_what_the_whole_does() -> None:
    parts = ModelParts(model())
    (whole,) = run(model(), {"image": IMAGE})
    for cut in (["middle"], ["positive", "side"], ["side", "middle"]):
        inner = dict(zip(cut, run(parts.leading_to(cut), {"image": IMAGE}), strict=True))
        assert np.array_equal(run(parts.following(values(cut)), inner)[0], whole)


def test_a_part_takes_what_it_needs_and_gives_more_where_asked() -> None:
    parts = ModelParts(model())
    head = open_content(parts.following(values(["middle", "positive"]), ["side"]), "the head")
    assert sorted(each.name for each in head.get_inputs()) == ["middle", "positive"]
    assert [each.name for each in head.get_outputs()] == ["answer", "side"]
    assert head.get_modelmeta().custom_metadata_map == {"key": "kept"}
    unused = open_content(parts.following(values(["positive", "side", "middle"])), "the head")
    assert sorted(each.name for each in unused.get_inputs()) == ["positive", "side"]
    trunk = open_content(parts.leading_to(["side"]), "the trunk")
    assert trunk.get_modelmeta().custom_metadata_map == {}


def test_a_digest_is_of_the_arithmetic_and_not_of_names() -> None:
    plain, renamed = ModelParts(model()), ModelParts(model(words="_of_another_file"))
    for name in ("middle", "side", "positive"):
        assert plain.digest([name]) == renamed.digest([f"{name}_of_another_file"])
    assert plain.digest(["middle"]) == ModelParts(model(operation="Sub")).digest(["middle"])
    assert plain.digest(["side"]) != ModelParts(model(operation="Sub")).digest(["side"])
    assert plain.digest(["middle"]) != ModelParts(model(weight=2.5)).digest(["middle"])
    assert plain.digest(["middle", "side"]) != plain.digest(["side", "middle"])


def test_an_inner_value_that_is_not_there_is_named() -> None:
    parts = ModelParts(model())
    with pytest.raises(ValueError, match="no inner value 'absent'"):
        parts.leading_to(["absent"])
    with pytest.raises(ValueError, match="no inner value 'absent'"):
        parts.following(values(["middle"]), ["absent"])
    with pytest.raises(ValueError, match="no inner value 'absent'"):
        parts.digest(["middle", "absent"])
