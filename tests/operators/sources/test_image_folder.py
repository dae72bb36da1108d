"""Folders of images: stamps by number and by file time, and images that another program still writes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from dataflow.messages import CameraInfo, Image
from dataflow.operator import Source, SourceError
from dataflow.testing import play
from operators.sources import GrowingImageFolder, ImageFolder
from operators.sources.image_folder import HELD


def encoded(level: int, width: int = 6, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, np.full((4, width, 3), level, np.uint8))[1].tobytes()


def fill(folder: Path, *names: str) -> None:
    for level, name in enumerate(names):
        (folder / name).write_bytes(encoded(level))


def shown(source: Source) -> list[tuple[int, int]]:
    """Stamps and levels."""
    return [(m.stamp, int(m.data[0, 0, 0])) for m in play(source)["image"] if isinstance(m, Image)]


def test_images_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    fill(tmp_path, "cam0_frame10.png", "cam0_frame2.png", "cam0_frame9.png", "notes2.txt")

    assert shown(ImageFolder(path=str(tmp_path), rate=10, first_stamp=5)) == [
        (200_000_005, 1),
        (900_000_005, 2),
        (1_000_000_005, 0),
    ]
    assert shown(ImageFolder(path=str(tmp_path), pattern="*9.png")) == [(300_000_000, 2)]


def test_names_of_nanoseconds_are_exact(tmp_path: Path) -> None:
    fill(tmp_path, "1403636579813555456.png", "1403636579763555584.png")

    stamps = [stamp for stamp, _ in shown(ImageFolder(path=str(tmp_path), rate=1e9))]
    assert stamps == [1403636579763555584, 1403636579813555456]


def test_file_times_are_stamps_that_increase(tmp_path: Path) -> None:
    fill(tmp_path, "a.png", "b.png", "c.png")
    for name, time in (("a.png", 3000), ("b.png", 1000), ("c.png", 1000)):
        os.utime(tmp_path / name, ns=(time, time))

    assert shown(ImageFolder(path=str(tmp_path), stamps="file_time")) == [(1000, 1), (1001, 2), (3000, 0)]


def test_the_calibration_has_the_size_of_the_images(tmp_path: Path) -> None:
    fill(tmp_path, "1.png")
    [info] = play(ImageFolder(path=str(tmp_path), focal=5.0))["image_info"]

    assert isinstance(info, CameraInfo)
    assert (info.width, info.height, info.K[0, 0]) == (6, 4, 5)


@pytest.mark.parametrize(
    ("name", "content", "wrong"),
    [
        ("1.txt", b"", "has no image whose name is"),
        ("image.png", encoded(0), "image.png has no number: `stamps: file_time` needs none"),
        ("12345678901234567890.png", encoded(0), "has no number"),
        ("1.png", b"none", r"1.png \(4 bytes\) cannot be decoded"),
    ],
)
def test_a_folder_that_cannot_be_read_is_refused(tmp_path: Path, name: str, content: bytes, wrong: str) -> None:
    (tmp_path / name).write_bytes(content)

    with pytest.raises(SourceError, match=wrong):
        ImageFolder(path=str(tmp_path)).setup()


def test_an_image_of_another_size_and_one_that_is_none_are_passed_over(tmp_path: Path) -> None:
    fill(tmp_path, "2.png", "5.png")
    (tmp_path / "1.png").write_bytes(b"none")
    (tmp_path / "3.png").write_bytes(encoded(1, width=8))
    source = ImageFolder(path=str(tmp_path), rate=1e9)

    assert [m.stamp for m in play(source)["image"]] == [2, 5]
    assert source.summary()["passed_over"] == 2
    (tmp_path / "1.png").unlink()
    with pytest.raises(Exception, match=r"3.png has 8x4 pixels instead of 6x4"):
        play(ImageFolder(path=str(tmp_path), strict=True))
    with pytest.raises(SourceError, match="no folder"):
        ImageFolder(path=str(tmp_path / "none")).setup()


Act = Callable[[Path], object]


def growing(folder: Path, *acts: Act, stamps: str = "number") -> GrowingImageFolder:
    """A source during whose pauses these happen, one after the other; then the run ends."""

    class Scripted(GrowingImageFolder):
        def _follow(self):
            left = list(acts)

            def wait(seconds: float) -> bool:
                left.pop(0)(folder) if left else self.stop_reading()
                return True

            self._stopped.wait = wait
            return super()._follow()

    return Scripted(path=str(folder), rate=1e9, stamps=stamps)


def write(name: str, content: bytes) -> Act:
    return lambda folder: (folder / name).write_bytes(content)


def both(first: Act, second: Act) -> Act:
    return lambda folder: (first(folder), second(folder))


def nothing(folder: Path) -> None:
    pass


def test_images_that_come_are_read_once_whole(tmp_path: Path) -> None:
    fill(tmp_path, "1.jpg", "2.jpg")
    whole = encoded(50, suffix=".jpg")
    source = growing(
        tmp_path,
        nothing,
        write("3.jpg", whole[: len(whole) // 2]),
        both(write("3.jpg", whole[:-9]), write("4.jpg", encoded(60))),
        write("3.jpg", whole),  # the fourth, which has not changed, waits for it
        nothing,
    )

    assert shown(source) == [(1, 0), (2, 1), (3, 50), (4, 60)]
    assert source.summary() == {"clock": "number", "left_out": 0}


def test_pipes_folders_and_broken_links_are_no_images(tmp_path: Path) -> None:
    """Reading a pipe would wait for who writes into it."""
    fill(tmp_path, "a_1.png", "a_3.png")
    os.mkfifo(tmp_path / "a_2.png")
    (tmp_path / "a_4.png").mkdir()
    (tmp_path / "a_5.png").symlink_to("nowhere.png")
    (tmp_path / "a_6.png").symlink_to("a_6.png")
    source = ImageFolder(path=str(tmp_path))
    assert len(play(source)["image"]) == 2
    assert source.summary()["passed_over"] == 0


def test_images_that_are_late_or_damaged_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fill(tmp_path, "5.png")
    source = growing(
        tmp_path,
        nothing,
        write("4.png", encoded(1)),
        nothing,
        write("6.png", b"damaged"),
        write("thumbnail.png", encoded(2)),
        write("7.png", encoded(3)),
        nothing,
    )

    assert shown(source) == [(5, 0), (7, 3)]
    assert source.summary()["left_out"] == 3
    assert "3 images of" in source.finding()
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert sorted(warning.split(" is left out: ")[0] for warning in warnings) == [
        "image 4.png",
        "image 6.png",
        "image thumbnail.png",
    ]


def test_a_file_that_never_settles_does_not_hold_the_others(tmp_path: Path) -> None:
    fill(tmp_path, "1.png")
    grows = [write("2.png", b"x" * size) for size in range(1, HELD + 3)]
    source = growing(tmp_path, nothing, write("3.png", encoded(1)), *grows)

    assert shown(source) == [(1, 0), (3, 1)]
    assert source.summary()["left_out"] == 1


def test_a_folder_that_is_gone_is_looked_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "stick"
    folder.mkdir()
    fill(folder, "1.png")
    source = growing(
        folder,
        nothing,
        lambda _: folder.rename(tmp_path / "pulled"),
        nothing,
        lambda _: (tmp_path / "pulled").rename(folder),
        write("2.png", encoded(1)),
        nothing,
    )

    assert shown(source) == [(1, 0), (2, 1)]
    assert [record.levelname for record in caplog.records].count("WARNING") == 1


def test_file_times_that_are_equal_come_in_any_look(tmp_path: Path) -> None:
    def at(name: str, level: int) -> Act:
        def put(folder: Path) -> None:
            (folder / name).write_bytes(encoded(level))
            os.utime(folder / name, ns=(1000, 1000))

        return put

    at("a.png", 0)(tmp_path)
    at("b.png", 1)(tmp_path)
    source = growing(tmp_path, nothing, at("c.png", 2), nothing, stamps="file_time")

    assert shown(source) == [(1000, 0), (1001, 1), (1002, 2)]


def test_the_wait_for_the_first_image_is_bounded(tmp_path: Path) -> None:
    source = GrowingImageFolder(path=str(tmp_path), every=10_000_000, first_within=20_000_000)

    with pytest.raises(SourceError, match="no image whose name is '\\*' came within"):
        source.setup()
