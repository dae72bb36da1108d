"""Decoders of compressed images and depth images, as recordings and network cameras carry them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CompressedDepth, CompressedImage, DepthImage, Diagnostics, Image, Level, Message
from dataflow.operator import In, Operator, Out, Param
from operators.passed_over import PassedOver
from operators.status import counted_status


class UndecodableError(ValueError):
    """A file that is damaged or cut short."""


class _Decoder(Operator, abstract=True):
    """Holds what both operators share: a file that is damaged or cut short is passed over, and reported."""

    stateless = True

    max_pixels: int = Param(64_000_000, ge=1, tunable=True, doc="a file that decodes to more pixels is refused")

    @cached_property
    def _passed_over(self) -> PassedOver:
        return PassedOver(self.log, strict=False)

    def _reported(self, name: str, stamp: int, error: UndecodableError) -> Mapping[str, Message]:
        """Reports a file on the status stream, and few of them in the log."""
        self._passed_over.take(error)
        return {"status": counted_status(name, stamp, f"passed over: {error}", Level.WARN, {})}


class ImageDecoder(_Decoder):
    """Decodes JPEG, PNG or WebP files to images: grey files to grey images, all others to RGB.

    A file that is damaged or cut short is passed over, and reported. JPEG has no checksums: a file that is whole and
    has wrong bytes in the middle decodes to wrong pixels.
    """

    compressed: In[CompressedImage] = In(doc="the encoded file")
    image: Out[Image] = Out(doc="its pixels, of the same stamp and frame")
    status: Out[Diagnostics] = Out(doc="a warning for each file that cannot be decoded, with the reason")

    def process(self, compressed: CompressedImage) -> Mapping[str, Message]:
        """Raises ValueError for a file of more than `max_pixels`."""
        try:
            return {"image": self.decode(compressed)}
        except UndecodableError as error:
            return self._reported("image_decoder", compressed.stamp, error)

    def decode(self, compressed: CompressedImage) -> Image:
        """Returns the image. Raises ValueError where the bytes are not a whole one."""
        # Without IMREAD_ANYDEPTH OpenCV answers with bytes, whatever the file holds.
        flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = _decoded(compressed, flags, self.max_pixels).astype(np.uint8, copy=False)
        if pixels.ndim == 3:
            pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)
        return Image(stamp=compressed.stamp, frame=compressed.frame, data=pixels)


class DepthDecoder(_Decoder):
    """Decodes 16-bit PNG files to depth images in metres.

    The pixel value 0 is no return. Where the depths were multiples of the quantiser's step, as from a camera that
    measures in such steps, the result is bit by bit the depth image that was compressed. A file that is damaged or cut
    short is passed over, and reported.
    """

    compressed: In[CompressedDepth] = In(doc="the encoded file and what its numbers mean")
    depth: Out[DepthImage] = Out(doc="metres, 0 for no return, of the same stamp and frame")
    status: Out[Diagnostics] = Out(doc="a warning for each file that cannot be decoded, with the reason")

    def process(self, compressed: CompressedDepth) -> Mapping[str, Message]:
        """Raises ValueError for a file of more than `max_pixels`."""
        try:
            return {"depth": self.decode(compressed)}
        except UndecodableError as error:
            return self._reported("depth_decoder", compressed.stamp, error)

    def decode(self, compressed: CompressedDepth) -> DepthImage:
        """Returns the depth image. Raises ValueError where the bytes are not a whole file of one."""
        levels = _decoded(compressed, cv2.IMREAD_UNCHANGED, self.max_pixels)
        metres = depth_in_metres(
            levels.astype(np.uint16, copy=False), compressed.quantizer, compressed.scale, compressed.offset
        )
        return DepthImage(stamp=compressed.stamp, frame=compressed.frame, data=metres)


def depth_in_metres(levels: NDArray[np.uint16], quantizer: str, scale: float, offset: float) -> NDArray[np.float32]:
    """Metres of pixel values v: scale · v + offset (linear) or scale / (v − offset) (inverse); 0 where v is 0.

    An inverse value at or below the offset has no depth either: it is 0.
    """
    v = levels.astype(np.float64)
    if quantizer == "linear":
        return np.where(levels > 0, scale * v + offset, 0).astype(np.float32)
    usable = (levels > 0) & (v > offset)
    return np.where(usable, scale / np.where(usable, v - offset, 1), 0).astype(np.float32)


def _decoded(message: CompressedImage | CompressedDepth, flags: int, max_pixels: int) -> NDArray[np.generic]:
    # A file that was cut short is decoded as far as it goes, without a word: its end must be looked for.
    pixels = cv2.imdecode(message.data, flags) if _is_whole(message.data.tobytes()) else None
    if pixels is None:
        raise UndecodableError(
            f"{message.SCHEMA} at stamp {message.stamp} ({len(message.data)} bytes) cannot be decoded: "
            f"the file is damaged or cut short"
        )
    if pixels.shape[0] * pixels.shape[1] > max_pixels:
        raise ValueError(
            f"{message.SCHEMA} at stamp {message.stamp} has {pixels.shape[1]}x{pixels.shape[0]} pixels, "
            f"more than max_pixels={max_pixels}"
        )
    return np.asarray(pixels)


def _is_whole(data: bytes) -> bool:
    """Returns whether a PNG, JPEG or WebP file goes on to its end mark or its declared length; bytes may follow, as
    cameras pad their files."""
    if data.startswith(b"\x89PNG"):
        return b"IEND\xaeB`\x82" in data
    if data.startswith(b"\xff\xd8"):
        return data.find(b"\xff\xd9", _scan_of(data)) >= 0
    return not data.startswith(b"RIFF") or len(data) >= 8 + int.from_bytes(data[4:8], "little")


def _scan_of(data: bytes) -> int:
    """The place of the pixels of a JPEG, behind its segments: the preview in one of them has an end mark, too."""
    at = 2
    while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] not in (b"\xda", b""):
        fill = data[at + 1] == 0xFF
        at += 1 if fill else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return at
