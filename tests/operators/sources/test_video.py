"""Video files frame by frame, and cameras that are unplugged and come back; the camera is a stand-in."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from made_video import ENCODERS, PERIOD, mp4

from dataflow.messages import CameraInfo, Image
from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import VideoFile, Webcam
from operators.sources.video import SILENT

SIZE = (48, 32)


def picture(level: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """BGR: blue as given, red the rest."""
    bgr = np.zeros((size[1], size[0], 3), np.uint8)
    bgr[:, :, 0], bgr[:, :, 2] = level, 255 - level
    return bgr


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, SIZE)
    assert writer.isOpened()
    for k in range(5):
        writer.write(picture(40 * k))
    writer.release()
    return path


def images(source: Any) -> list[Image]:
    return [m for m in play(source)["image"] if isinstance(m, Image)]


def test_every_frame_of_a_file_is_an_image_at_its_time(clip: Path, caplog: pytest.LogCaptureFixture) -> None:
    found, again = (images(VideoFile(input=str(clip), first_stamp=7)) for _ in range(2))

    assert [m.digest() for m in found] == [m.digest() for m in again]
    assert "can be decoded" not in caplog.text
    assert [m.stamp for m in found] == [7 + k * 50_000_000 for k in range(5)]
    for k, image in enumerate(found):
        red, _, blue = image.data.mean((0, 1))
        assert abs(blue - 40 * k) < 4
        assert abs(red - (255 - 40 * k)) < 4


@pytest.mark.parametrize("format_", ["h264", "h265"])
def test_files_with_b_frames_give_the_frames_in_their_order(format_: str, tmp_path: Path) -> None:
    file = mp4(tmp_path / "episode_000000.mp4", ENCODERS[format_])
    with av.open(file) as container:
        expected = [frame.to_ndarray(format="bgr24")[..., ::-1] for frame in container.decode(video=0)]

    found = images(VideoFile(input=str(file)))

    assert [m.stamp for m in found] == [k * PERIOD for k in range(20)]
    assert all(np.array_equal(m.data, frame) for m, frame in zip(found, expected, strict=True))


def test_a_file_of_av1_is_refused_by_its_codec(tmp_path: Path) -> None:
    file = tmp_path / "episode_000000.mp4"
    apart = multiprocessing.get_context("spawn").Process(target=mp4, args=(file, "libsvtav1"))  # it sets its scheduler
    apart.start()
    apart.join(60)
    with pytest.raises(SourceError, match=r"its codec is AV01\. .* no AV1: encode it anew"):
        VideoFile(input=str(file)).setup()


def test_a_file_of_which_frames_are_missing_is_named(clip: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = bytearray(clip.read_bytes())
    second = data.index(b"00dc", data.index(b"00dc") + 4)
    data[second : second + 300] = bytes(300)
    clip.write_bytes(data)

    found = images(VideoFile(input=str(clip)))

    assert 0 < len(found) < 5
    assert f"states 5 frames, and {len(found)} can be decoded" in caplog.text


def test_part_of_a_file_at_another_rate(clip: Path) -> None:
    found = images(VideoFile(input=str(clip), rate=10, start=1, stop=3))

    assert [m.stamp for m in found] == [100_000_000, 200_000_000]


def test_the_calibration_follows_the_field_of_view_or_the_focal_length(clip: Path) -> None:
    [wide] = play(VideoFile(input=str(clip), fov=np.pi / 2))["image_info"]
    [known] = play(VideoFile(input=str(clip), focal=50.0))["image_info"]

    assert isinstance(wide, CameraInfo)
    assert isinstance(known, CameraInfo)
    assert wide.K[0, 0] == pytest.approx(24)
    assert (wide.width, wide.height, wide.K[0, 2]) == (48, 32, 23.5)
    assert known.K[1, 1] == 50


@pytest.mark.parametrize(("content", "wrong"), [(None, "no file .*x.avi"), (b"no video", "is no video")])
def test_file_that_is_no_video_is_refused_by_name(tmp_path: Path, content: bytes | None, wrong: str) -> None:
    path = tmp_path / "x.avi"
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(Exception, match=wrong):
        play(VideoFile(input=str(path)))


class Camera:
    """A camera that gives what it was told to; None for nothing."""

    def __init__(self, reads: list[np.ndarray | None]) -> None:
        self.reads, self.released = reads, False

    def read(self) -> tuple[bool, np.ndarray | None]:
        read = self.reads.pop(0) if self.reads else None
        return read is not None, read

    def release(self) -> None:
        self.released = True


def webcam(monkeypatch: pytest.MonkeyPatch, *cameras: Camera | None) -> Webcam:
    """A webcam whose looks for the camera find these, one after the other; then the run ends."""
    left = list(cameras)

    def found(self: Webcam) -> Camera | None:
        if not left:
            self.stop_reading()
            return None
        return left.pop(0)

    monkeypatch.setattr(Webcam, "_open", found)
    return Webcam(retry=10_000_000)


def test_a_camera_that_is_unplugged_goes_on_when_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    first = Camera([picture(0), picture(10), None, picture(20)])  # one image that did not come is no reason
    second = Camera([picture(30), picture(40)])
    found = images(webcam(monkeypatch, first, None, second))

    levels = [round(float(m.data[0, 0, 2])) for m in found]
    assert levels == [10, 20, 40]  # the first image of each tells the size
    assert all(a.stamp < b.stamp for a, b in pairwise(found))
    assert first.released
    assert second.released


def test_images_go_on_when_the_clock_was_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    source = webcam(monkeypatch, Camera([picture(0), *(picture(10) for _ in range(5))]))
    source.setup()
    hour = 3600 * 1_000_000_000
    less = hour - 200_000_000
    clock = iter([2 * hour, 2 * hour - 5, hour, hour + 5, less])
    monkeypatch.setattr(time, "time_ns", lambda: next(clock))

    stamps = [step["image"].stamp for step in islice(source.stream(), 4)]

    assert stamps == [2 * hour, hour, hour + 5, less]
    assert source.summary()["past"] == 1


def test_a_camera_that_comes_back_with_another_size_ends_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    source = webcam(monkeypatch, Camera([picture(0)]), Camera([picture(0, (64, 32))]))

    with pytest.raises(Exception, match="came back with 64x32 pixels instead of 48x32"):
        play(source)


@pytest.mark.parametrize(
    ("camera", "wrong"),
    [(None, "does not open; this machine has"), (Camera([None] * SILENT), "gives no image: another program")],
)
def test_a_camera_that_is_not_there_at_the_start_is_an_error(
    monkeypatch: pytest.MonkeyPatch, camera: Camera | None, wrong: str
) -> None:
    source = webcam(monkeypatch, camera)

    with pytest.raises((SourceError, Exception), match=wrong):
        play(source)


def test_a_file_stands_for_a_camera_too(clip: Path) -> None:
    """OpenCV opens both alike, so this runs the code that talks to it."""
    source = Webcam(input=str(clip), retry=10_000_000)
    source.setup()
    read: Iterator[Any] = source.stream()
    shown = [next(read)["image"] for _ in range(4)]
    source.stop_reading()

    assert len(list(read)) == 0
    assert all(isinstance(m, Image) and m.width == 48 for m in shown)
    source.close()
