"""Depth is recorded in two bytes a pixel where whole millimetres give back the same bits, and as floats elsewhere."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from dataflow.messages import DepthImage
from dataflow.recording import RecordingError
from dataflow.recording.streams.codecs import codec_for
from dataflow.recording.streams.foxglove.images import decode_raw
from dataflow.recording.streams.pixels import as_depth, as_millimetres

CODEC = codec_for(DepthImage)


def depth(data: npt.ArrayLike) -> DepthImage:
    return DepthImage(stamp=7, frame="camera", data=np.asarray(data, np.float32))


def recorded(message: DepthImage) -> tuple[RawImage, DepthImage]:
    """The protobuf as it lies in a file, and what is read from it."""
    parts, companion = CODEC.encode(message)
    data = b"".join(parts)
    assert companion is None
    return RawImage.FromString(data), CODEC.decode(message.stamp, memoryview(data), companion)


def test_all_whole_millimetres_of_two_bytes_are_kept() -> None:
    message = depth((np.arange(2**16) / 1000).reshape(256, 256))

    proto, read = recorded(message)

    assert (proto.encoding, proto.step, len(proto.data)) == ("16UC1", 512, 2 * 2**16)
    assert np.frombuffer(proto.data, "<u2").tolist() == list(range(2**16))
    assert read.digest() == message.digest()
    assert not read.data.flags.writeable


@pytest.mark.parametrize(
    "odd", [math.nan, -0.0, -1.0, math.inf, 65.536, 1e30, 0.0005, np.nextafter(np.float32(1.5), np.float32(2)), 1e-45]
)
def test_one_pixel_that_is_no_whole_millimetre_makes_floats(odd: float) -> None:
    data = np.full((40, 30), 1.5, np.float32)
    data[23, 17] = odd
    message = depth(data)

    proto, read = recorded(message)

    assert (proto.encoding, proto.data) == ("32FC1", data.tobytes())
    assert read.digest() == message.digest()


def test_thousandths_multiplied_in_single_precision_are_kept_as_they_are() -> None:
    message = depth(np.arange(5000, dtype=np.float32).reshape(50, 100) * np.float32(0.001))

    proto, read = recorded(message)

    assert proto.encoding == "32FC1"
    assert read.digest() == message.digest()


@given(arrays(np.uint32, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(0, 2**32 - 1)))
def test_any_bits_are_kept(bits: npt.NDArray[np.uint32]) -> None:
    message = depth(bits.view(np.float32))

    assert recorded(message)[1].digest() == message.digest()


@given(arrays(np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=40)))
def test_any_millimetres_take_two_bytes(whole: npt.NDArray[np.uint16]) -> None:
    metres = (whole / 1000).astype(np.float32)

    found = as_millimetres(metres)

    assert found is not None
    assert np.array_equal(found, whole)


def test_another_encoding_is_refused() -> None:
    with pytest.raises(RecordingError, match="'mono16' is no DepthImage; those known are 32FC1, 64FC1, 16UC1"):
        decode_raw(as_depth, RawImage(encoding="mono16", width=1, height=1, data=bytes(2)))
