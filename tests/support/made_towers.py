"""A small image-text network of CLIP's signature: images are known by their mean colour, texts by words for colours."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from operators.language.bpe import Tokenizer

SIDE = 32
WORDS = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}


def write_merges(file: Path, words: Sequence[str] = tuple(WORDS)) -> Path:
    """A list of merges by which each of the words is one token."""
    pairs = ["#version: made"]
    for word in words:
        symbols = [*word[:-1], f"{word[-1]}</w>"]
        while len(symbols) > 1:
            pairs.append(f"{symbols[-2]} {symbols[-1]}")
            symbols[-2:] = ["".join(symbols[-2:])]
    file.write_text("\n".join(dict.fromkeys(pairs)) + "\n", encoding="utf-8")
    return file


def write_image_tower(file: Path, *, half: bool = False, batch: bool = True, side: int | None = SIDE) -> Path:
    """Pixels (N, 3, S, S), normalised as for CLIP or not → the mean colour (N, 3), float16 with `half`."""
    import onnx
    from onnx import helper

    kind = onnx.TensorProto.FLOAT16 if half else onnx.TensorProto.FLOAT
    count = "n" if batch else 1
    nodes = [
        helper.make_node("GlobalAveragePool", ["pixel_values"], ["mean"]),
        helper.make_node("Flatten", ["mean"], ["image_embeds"]),
        helper.make_node("Identity", ["pixel_values"], ["last_hidden_state"]),
    ]
    shape = [count, 3, side or "height", side or "width"]
    outputs = {"last_hidden_state": shape, "image_embeds": [count, 3]}
    return _saved(file, nodes, {"pixel_values": (kind, shape)}, {name: (kind, s) for name, s in outputs.items()})


def write_text_tower(file: Path, merges: Path, *, mask: bool = True) -> Path:
    """Tokens (N, 77) of int64 and their mask → the sum of their colours (N, 3)."""
    import onnx
    from onnx import helper, numpy_helper

    tokenizer = Tokenizer(merges)
    colors = np.zeros((tokenizer.end + 1, 3), np.float32)
    for word, color in WORDS.items():
        colors[tokenizer([word])[0, 1]] = color
    colors[0] = 9.0  # of what is after the end, where no mask hides it
    last = "shown" if mask else "each"
    nodes = [helper.make_node("Gather", ["colors", "input_ids"], ["each"])]
    if mask:
        nodes += [
            helper.make_node("Cast", ["attention_mask"], ["weights"], to=onnx.TensorProto.FLOAT),
            helper.make_node("Unsqueeze", ["weights", "behind"], ["column"]),
            helper.make_node("Mul", ["each", "column"], ["shown"]),
        ]
    nodes.append(helper.make_node("ReduceSum", [last, "middle"], ["text_embeds"], keepdims=0))
    kind = onnx.TensorProto.INT64
    values = {"colors": colors, "behind": np.array([2]), "middle": np.array([1])}
    inputs = {"input_ids": (kind, ["n", "length"])} | ({"attention_mask": (kind, ["n", "length"])} if mask else {})
    outputs = {"text_embeds": (onnx.TensorProto.FLOAT, ["n", 3])}
    return _saved(file, nodes, inputs, outputs, [numpy_helper.from_array(v, name) for name, v in values.items()])


def write_open_detector(file: Path, merges: Path, boxes: Any, colors: Any, *, mask_first: bool = False) -> Path:
    """A network of OWL-ViT's signature: it finds boxes (N, 4), which have colours (N, 3), by words for these."""
    import onnx
    from onnx import helper, numpy_helper

    text = onnx.load(write_text_tower(file.with_suffix(".text.onnx"), merges)).graph
    nodes = [
        *text.node,
        helper.make_node("Transpose", ["text_embeds"], ["by_class"], perm=[1, 0]),
        helper.make_node("MatMul", ["of_boxes", "by_class"], ["alike"]),
        helper.make_node("ReduceMean", ["pixel_values"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Sub", ["mean", "mean"], ["nothing"]),
        helper.make_node("Add", ["alike", "nothing"], ["rows"]),
        helper.make_node("Unsqueeze", ["rows", "first"], ["logits"]),
        helper.make_node("Identity", ["given"], ["pred_boxes"]),
    ]
    given = np.array(boxes, np.float32)[None]
    values = {"of_boxes": np.array(colors, np.float32), "first": np.array([0]), "given": given}
    number, real = onnx.TensorProto.INT64, onnx.TensorProto.FLOAT
    inputs = {
        "input_ids": (number, ["c", "length"]),
        "pixel_values": (real, [1, 3, 48, 64]),
        "attention_mask": (number, ["c", "length"]),
    }
    inputs = dict(reversed(inputs.items())) if mask_first else inputs
    outputs = {
        "logits": (real, [1, given.shape[1], "c"]),
        "pred_boxes": (real, list(given.shape)),
        "text_embeds": (real, ["c", 3]),
    }
    kept = [*text.initializer, *(numpy_helper.from_array(v, name) for name, v in values.items())]
    return _saved(file, nodes, inputs, outputs, kept)


def write_row(folder: Path, name: str = "colors") -> Path:
    """A registry file with a row of the towers, whose files lie in a cache beside it."""
    cache = folder / "cache"
    cache.mkdir(parents=True, exist_ok=True)
    tokenizer = write_merges(cache / f"{name}.tokenizer.txt")
    text = write_text_tower(cache / f"{name}.text.onnx", tokenizer)
    image = write_image_tower(cache / f"{name}.onnx")

    def entry(file: Path) -> dict[str, Any]:
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        return {"source": {"url": f"file://{file}"}, "sha256": sha256}

    row = {
        "about": "colours",
        "task": "embedding",
        "operator": "operators.recognition:FeatureExtractor",
        "params": {"normalization": "unit"},
        "input": f"{SIDE}x{SIDE} RGB",
        "licence": {"code": "MIT", "weights": "MIT"},
        "home": "here",
        "published": "nothing",
        "parts": {"text": entry(text), "tokenizer": entry(tokenizer)},
        **entry(image),
    }
    file = folder / "registry.yaml"
    file.write_text(json.dumps({"models": {name: row}}), encoding="utf-8")
    return file


def _saved(file: Path, nodes: list[Any], inputs: Any, outputs: Any, values: Sequence[Any] = ()) -> Path:
    import onnx
    from onnx import helper

    ports = [[helper.make_tensor_value_info(n, k, s) for n, (k, s) in each.items()] for each in (inputs, outputs)]
    graph = helper.make_graph(nodes, "tower", *ports, list(values))
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(file))
    return file
