"""RVL, against its encoder written as in the paper, one pixel after the other."""

from __future__ import annotations

import numpy as np
import pytest
from made_rvl import packed_rvl

from dataflow.interop.ros.rvl import unpacked_rvl
from dataflow.recording import RecordingError


def images() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    holes = rng.integers(400, 5000, (24, 32)).astype(np.uint16)
    holes[rng.random(holes.shape) < 0.3] = 0
    slope = (1000 + np.arange(24 * 32).reshape(24, 32)).astype(np.uint16)
    return {
        "holes": holes,
        "slope": slope,
        "empty": np.zeros((24, 32), np.uint16),
        "extremes": np.where(holes % 2 == 0, 65535, 1).astype(np.uint16),
    }


@pytest.mark.parametrize("name", images())
def test_images_come_back_bit_for_bit(name: str) -> None:
    image = images()[name]

    found = unpacked_rvl(np.frombuffer(packed_rvl(image), np.uint8), image.size)

    np.testing.assert_array_equal(found.reshape(image.shape), image)


@pytest.mark.parametrize("data", [b"", b"\xff" * 64, bytes(8), np.array([0x12345678], "<u4").tobytes()])
def test_malformed_rvl_data_is_refused(data: bytes) -> None:
    with pytest.raises(RecordingError, match="RVL"):
        unpacked_rvl(np.frombuffer(data, np.uint8), 768)
