"""A camera of the network over RTSP, on loopback: its images come, and again after the connection was lost."""

from __future__ import annotations

import numpy as np
import pytest
from rtsp_server import camera, shade

from dataflow.messages import Image
from dataflow.operator import SourceError
from operators.sources import Webcam


def grey(step: object) -> float:
    assert isinstance(step, Image)
    assert np.ptp(step.data) <= 6  # JPEG
    return float(step.data.mean())


def test_images_of_a_network_camera_come_in_order_and_again_after_the_connection_was_lost() -> None:
    with camera(range(30), range(100, 130)) as address:
        source = Webcam(input=address, retry="10ms", fov=1.0)
        source.setup()
        [info] = source.static_outputs().values()
        steps = source.stream()
        images = [next(steps)["image"] for _ in range(45)]
        source.stop_reading()
        assert list(steps) == []
        source.close()

    assert (info.width, info.height) == (64, 48)
    shown = [round((grey(image) - shade(0)) / 10) for image in images]
    before = len(shown) - 1 - shown[::-1].index(1)  # the last image 1 is the first of the second connection
    assert shown[:before] == [number % 20 for number in range(1, before + 1)]
    assert shown[before:] == [number % 20 for number in range(1, len(shown) - before + 1)]
    assert before >= 28  # setup() took the first, the connection may have cost the last
    assert [image.stamp for image in images] == sorted({image.stamp for image in images})
    assert source.summary() == {"clock": "machine", "past": 0, "unplugged": 1}


def test_a_network_camera_that_is_not_there_is_an_error() -> None:
    with camera() as address:
        pass
    with pytest.raises(SourceError, match=r"camera 'rtsp://127.0.0.1:.*' does not open"):
        Webcam(input=address).setup()
