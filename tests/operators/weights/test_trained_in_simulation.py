"""What a network was trained on, as its file says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from operators.protobuf import field
from operators.weights import shipped, trained_in_simulation
from operators.weights.network_file import KEY


def model(facts: object) -> bytes:
    """The metadata of an ONNX model, without its graph."""
    return field(14, field(1, KEY.encode()) + field(2, json.dumps(facts).encode()))


@pytest.mark.parametrize("name", ["activity", "detector", "posture", "segmenter"])
def test_shipped_networks_know_simulated_worlds_alone(name: str) -> None:
    assert trained_in_simulation(shipped(f"{name}.onnx"))


@pytest.mark.parametrize(
    ("content", "simulated"),
    [
        (model({"kind": "detector", "trained_on": "simulator"}), True),
        (model({"kind": "detector"}), False),
        (model({"kind": "detector", "trained_on": "photographs"}), False),
        (model([]), False),
        (field(14, field(1, b"other") + field(2, b"{}")), False),
        (b"\xff\xff no model", False),
    ],
)
def test_other_networks_say_so_in_their_metadata(content: bytes, simulated: bool, tmp_path: Path) -> None:
    file = tmp_path / "mine.onnx"
    file.write_bytes(content)
    assert trained_in_simulation(file) is simulated


def test_a_missing_file_is_left_to_setup(tmp_path: Path) -> None:
    assert not trained_in_simulation(tmp_path / "none.onnx")
