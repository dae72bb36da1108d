"""Images and depth images, raw and compressed."""

from __future__ import annotations

from typing import Any

import numpy as np

from dataflow.messages.arrays import F32, U8, U16
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import finite, not_empty, positive
from dataflow.messages.display import pictures
from dataflow.messages.display.pictures import Picture

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
FORMATS = ("jpeg", "png", "webp")
VIDEO_FORMATS = ("h264", "h265")
START_CODES = (b"\0\0\1", b"\0\0\0\1")


class _Raster:
    """The size of `data`."""

    data: Any

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.data.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.data.shape[1])


class Image(_Raster, Message):
    """A colour or grey image, as the camera's optical frame sees it; stamped at the middle of its exposure."""

    frame: str = scalar("str", "optical frame of the camera (z forward, x right, y down)", default=ANCHOR)
    data: U8 = array("uint8", "H W 3|H W", "RGB pixels, or one grey channel; row 0 is the top; at least one pixel")

    def validate(self) -> None:
        not_empty(self, "data")

    @property
    def is_color(self) -> bool:
        """Returns whether there are three channels."""
        return self.data.ndim == 3

    def _picture(self) -> Picture | None:
        return pictures.of_pixels(self.data)


class Image16(_Raster, Message):
    """A colour or grey image of 16 bits a channel, of thermal and scientific cameras; values in the camera's own
    scale."""

    frame: str = scalar("str", "optical frame of the camera (z forward, x right, y down)", default=ANCHOR)
    data: U16 = array("uint16", "H W 3|H W", "RGB pixels, or one grey channel; row 0 is the top; at least one pixel")

    def validate(self) -> None:
        not_empty(self, "data")

    def _picture(self) -> Picture | None:
        return pictures.of_pixels((self.data >> 8).astype(np.uint8))


class CompressedImage(Message):
    """A colour or grey image as an encoded file."""

    frame: str = scalar("str", "optical frame of the camera (z forward, x right, y down)", default=ANCHOR)
    format: str = scalar("str", "how the bytes are encoded", choices=FORMATS)
    data: U8 = array("uint8", "N", "the bytes of the encoded file")

    def validate(self) -> None:
        head = self.data[:12].tobytes()
        found = file_format(head)
        if found != self.format:
            raise MessageError(
                f"CompressedImage.data must hold a {self.format} file, got {len(self.data)} bytes that begin with "
                f"{head.hex(' ')}" + (f", which is {found}" if found else "")
            )

    def _picture(self) -> Picture | None:
        return self.format, self.data.tobytes()


class CompressedVideo(Message):
    """One picture of a video stream; most need the messages before it, back to a key frame, to be decoded.

    Its bytes are in Annex B form (ITU-T H.264, H.265), of one picture, and in the order of time, so without B-frames. A
    key frame comes with its parameter sets (SPS, PPS; VPS), so that decoding can begin with it.
    """

    frame: str = scalar("str", "optical frame of the camera (z forward, x right, y down)", default=ANCHOR)
    format: str = scalar("str", "how the stream is encoded", choices=VIDEO_FORMATS)
    data: U8 = array("uint8", "N", "NAL units of one picture, each after a start code")

    def validate(self) -> None:
        head = self.data[:4].tobytes()
        if not head.startswith(START_CODES):
            raise MessageError(
                f"CompressedVideo.data must begin with a start code (00 00 01), as in Annex B of {self.format}, got "
                f"{len(self.data)} bytes that begin with {head.hex(' ')}"
            )


class DepthImage(_Raster, Message):
    """Distance along the optical axis (z, not range) per pixel."""

    frame: str = scalar("str", "optical frame of the depth camera (z forward, x right, y down)", default=ANCHOR)
    data: F32 = array("float32", "H W", "depth; 0 or NaN where there was no return; at least one pixel", unit="m")

    def validate(self) -> None:
        not_empty(self, "data")

    def _picture(self) -> Picture | None:
        return pictures.of_depth(self.data)


class RelativeDepth(_Raster, Message):
    """Nearness per pixel: inverse depth up to an unknown factor and constant, as estimated from one image."""

    frame: str = scalar("str", "optical frame of the camera (z forward, x right, y down)", default=ANCHOR)
    data: F32 = array(
        "float32",
        "H W",
        "nearness, larger is nearer; NaN where not known; at least one pixel",
        unit="1/m up to factor and constant",
    )

    def validate(self) -> None:
        not_empty(self, "data")

    def _picture(self) -> Picture | None:
        return pictures.of_nearness(self.data)


class CompressedDepth(Message):
    """A depth image as a 16-bit grey PNG; the pixel value 0 is no return.

    A value v > 0 stands for the depth `scale * v + offset` metres where `quantizer` is linear (a depth camera's own
    units, usually millimetres: scale 0.001), and for `scale / (v - offset)` where it is inverse (equal steps of inverse
    depth, as ROS's `compressedDepth` has them: scale is its quantisation parameter A, offset its B).
    """

    frame: str = scalar("str", "optical frame of the depth camera (z forward, x right, y down)", default=ANCHOR)
    quantizer: str = scalar("str", "how pixel values relate to depth", default="linear", choices=("linear", "inverse"))
    scale: float = scalar("float", "metres per unit (linear), or metres times units (inverse); above 0")
    offset: float = scalar("float", "metres (linear), or units (inverse)", default=0.0)
    data: U8 = array("uint8", "N", "the bytes of a PNG file with one 16-bit channel")

    def validate(self) -> None:
        positive(self, "scale")
        finite(self, "offset")
        head = self.data[:26].tobytes()
        if not head.startswith(PNG_SIGNATURE) or head[24:26] != b"\x10\x00":
            raise MessageError(
                f"CompressedDepth.data must hold a PNG file with one 16-bit channel, got {len(self.data)} bytes that "
                f"begin with {head.hex(' ')}"
            )

    def _picture(self) -> Picture | None:
        return "png", self.data.tobytes()


def file_format(head: bytes) -> str | None:
    """The format of an encoded image by its first 12 bytes."""
    if head.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if head.startswith(PNG_SIGNATURE):
        return "png"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "webp"
    return None
