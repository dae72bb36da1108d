"""Folders of images as a source: whole ones, and ones that another program still writes into."""

from __future__ import annotations

import fnmatch
import itertools
import os
import re
import threading
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from dataflow.messages import Message
from dataflow.operator import Duration, Param, SourceError
from operators.passed_over import PassedOver
from operators.sources.pacing import frame_stamp
from operators.sources.video import CalibratedImages, Pixels

SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"))
HELD = 50
"""Looks at a file that still changes, after which it is left out: those behind it wait for it."""
_NUMBER = re.compile(r"(?<!\d)(\d{1,19})\D*$")
"""The last number of a name."""
LATEST = 2**63 - 1


class _File(NamedTuple):
    stamp: int
    """-1 where the name has no number to stamp it by."""
    name: str
    size: int
    changed: int


class ImageFolder(CalibratedImages):
    """Reads the images of a folder in the order of their stamps.

    An image is stamped by the last number in its name, `first_stamp` + number / `rate` (`rate: 1e9`: names are
    nanoseconds), or with `stamps: file_time` by the time at which its file was last changed, on the clock of the
    machine that wrote it; at least 1 ns after the one before. One that cannot be decoded, or has another size than the
    first, is passed over with a warning.
    """

    path: str = Param(min_length=1, doc="the folder")
    pattern: str = Param("*", min_length=1, doc="names to read, such as left_*.png")
    stamps: Literal["number", "file_time"] = Param("number", doc="origin of the stamps")
    rate: float = Param(30.0, gt=0, unit="Hz", doc="numbers a second")
    first_stamp: int = Param(0, ge=0, unit="ns", doc="stamp of number 0")
    strict: bool = Param(False, doc="what cannot be read is an error, instead of being passed over and counted")

    def setup(self) -> None:
        """Raises SourceError for a folder without images, or an image that cannot be stamped or read."""
        self._folder = self._existing()
        self._passed = PassedOver(self.log, strict=self.strict)
        self._files = sorted(self._look())
        if not self._files:
            raise SourceError(f"{self._folder} has no image whose name is {self.pattern!r}")
        if self._files[0].stamp < 0:
            raise SourceError(f"{self._folder / self._files[0].name} has no number: `stamps: file_time` needs none")
        self._calibrate(self._passed.first(self._files, self._read))

    def stream(self) -> Iterator[Mapping[str, Message]]:
        last = -1
        for file in self._files:
            last = max(file.stamp, last + 1)
            try:
                yield self._sized(last, file.name, self._read(file))
            except SourceError as error:
                self._passed.take(error)

    def length(self) -> int | None:
        return len(self._files) if hasattr(self, "_files") else None

    def summary(self) -> Mapping[str, int | str]:
        return {"clock": self.stamps, "passed_over": self._passed.number}

    def finding(self) -> str:
        """Returns how many images are missing in the stream."""
        number = self._missing()
        return f"{number} image{'s' * (number != 1)} of {self.path} left out, each named in a warning" if number else ""

    def _missing(self) -> int:
        return self._passed.number if hasattr(self, "_passed") else 0

    def _existing(self) -> Path:
        folder = Path(self.path).expanduser()
        if not folder.is_dir():
            raise SourceError(f"no folder {self.path!r} (looked for {folder.absolute()})")
        return folder

    def _first_stamp(self) -> int:
        return self._files[0].stamp

    def _look(self, known: Container[str] = ()) -> Iterator[_File]:
        """Yields the images that are there, without those of known names. Raises OSError."""
        with os.scandir(self._folder) as entries:
            for entry in entries:
                name = entry.name
                fits = os.path.splitext(name)[1].lower() in SUFFIXES and fnmatch.fnmatchcase(name, self.pattern)
                if name in known or not fits:
                    continue
                try:
                    if not entry.is_file():  # reading a pipe would wait
                        continue
                    found = entry.stat()
                except OSError:  # gone since, or a link to itself
                    continue
                yield _File(self._stamp(name, found.st_mtime_ns), name, found.st_size, found.st_mtime_ns)

    def _stamp(self, name: str, changed: int) -> int:
        if self.stamps == "file_time":
            return changed
        found = _NUMBER.search(os.path.splitext(name)[0])
        stamp = -1 if found is None else frame_stamp(int(found[1]), self.rate, self.first_stamp)
        return stamp if stamp <= LATEST else -1

    def _read(self, file: _File) -> Pixels:
        bgr = cv2.imread(str(self._folder / file.name), cv2.IMREAD_COLOR)
        if bgr is None:
            raise SourceError(f"{self._folder / file.name} ({file.size} bytes) cannot be decoded as an image")
        return np.asarray(bgr, np.uint8)

    def _sized(self, stamp: int, name: str, bgr: Pixels) -> Mapping[str, Message]:
        if _size(bgr) != self._size:
            raise SourceError(
                f"{self._folder / name} has {bgr.shape[1]}x{bgr.shape[0]} pixels instead of "
                f"{self._size[0]}x{self._size[1]}"
            )
        return self._image(stamp, bgr)


class GrowingImageFolder(ImageFolder):
    """Reads the images of a folder, then those that come, until the run ends.

    A file is read once its size and time were the same in two looks, `every` apart; a program that renames files into
    the folder is safe at any pace. Images that come with a stamp of the past, cannot be decoded, have no number, or
    change for 50 looks are left out with a warning, and counted.
    """

    real_time = True

    every: Duration = Param("200ms", ge=10_000_000, doc="time between two looks")
    first_within: Duration = Param("10s", ge=0, doc="time for the first image, whose size the calibration needs")

    _left_out = 0

    def setup(self) -> None:
        """Raises SourceError where there is no folder, or no image in time."""
        self._stopped = threading.Event()
        self._passed = PassedOver(self.log, strict=self.strict)
        self._folder = self._existing()
        self._done: set[str] = set()
        self._before: dict[str, _File] = {}
        self._held: Counter[str] = Counter()
        self._reachable = True
        self._new = self._follow()
        looks = 2 + self.first_within // self.every
        first = next((found for found in itertools.islice(self._new, looks) if found is not None), None)
        if first is None:
            raise SourceError(f"{self._folder}: no image whose name is {self.pattern!r} came within `first_within`")
        self._first = first
        self._calibrate(first[2])

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for found in itertools.chain([self._first], self._new):
            if found is None:
                continue
            try:
                yield self._sized(*found)
            except SourceError as error:
                self._passed.take(error)

    def stop_reading(self) -> None:
        self._stopped.set()

    def length(self) -> int | None:
        return None

    def summary(self) -> Mapping[str, int | str]:
        return {"clock": self.stamps, "left_out": self._missing()}

    def _missing(self) -> int:
        return self._left_out + super()._missing()

    def _first_stamp(self) -> int:
        return self._first[0]

    def _follow(self) -> Iterator[tuple[int, str, Pixels] | None]:
        """Yields (stamp, name, pixels) of each image that has come, and None after each look."""
        newest, last = -1, -1
        while not self._stopped.is_set():
            for file in self._settled():
                self._done.add(file.name)
                if file.stamp < newest:
                    self._leave_out(file.name, "its stamp is earlier than that of the image before")
                    continue
                try:
                    bgr = self._read(file)
                except SourceError as error:
                    if self.strict:
                        raise
                    self._leave_out(file.name, str(error))
                    continue
                newest, last = file.stamp, max(file.stamp, last + 1)
                yield last, file.name, bgr
            yield None
            self._stopped.wait(self.every * 1e-9)

    def _settled(self) -> list[_File]:
        """New files that have not changed since the last look, by stamp, up to the first that has."""
        try:
            found = sorted(self._look(self._done))
        except OSError as error:
            if self._reachable:
                self.log.warning("folder %s is gone (%s): it is looked for", self._folder, error.strerror)
            self._reachable = False
            return []
        self._reachable = True
        before, self._before = self._before, {file.name: file for file in found}
        settled: list[_File] = []
        for file in found:
            if file.stamp < 0:
                self._leave_out(file.name, "its name has no number")
            elif before.get(file.name) == file:
                settled.append(file)
                self._held.pop(file.name, None)
            elif self._held[file.name] >= HELD:
                self._leave_out(file.name, f"it changes since {HELD} looks")
            else:
                self._held[file.name] += 1
                break
        return settled

    def _leave_out(self, name: str, why: str) -> None:
        self._done.add(name)
        self._left_out += 1
        self.log.warning("image %s is left out: %s", name, why)


def _size(bgr: Pixels) -> tuple[int, int]:
    return bgr.shape[1], bgr.shape[0]
