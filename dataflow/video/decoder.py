"""Decodes a stream of packets, each as soon as it comes, and finds those that cannot be decoded."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.video.bits import PacketError, VideoError
from dataflow.video.capture import Capture
from dataflow.video.h264 import H264Headers
from dataflow.video.h264 import is_key as is_h264_key
from dataflow.video.h265 import H265Headers
from dataflow.video.h265 import is_key as is_h265_key
from dataflow.video.picture import Headers, Picture

MAX_GROUP = 64 << 20
"""Bytes of packets since a key frame that are kept for a snapshot."""
_PERIODS = 9
"""Times between packets of which the median counts."""
_HEADERS: dict[str, Callable[[], Headers]] = {"h264": H264Headers, "h265": H265Headers}


def is_key(format_: str, data: bytes) -> bool:
    """Returns whether decoding can begin with a packet: a key frame with its parameter sets."""
    return is_h264_key(data) if format_ == "h264" else is_h265_key(data)


class Pace:
    """The stamps of the packets since a key frame, which show losses that the numbers of pictures hide.

    `stamps`: of the packets (ns); None where they are not known.
    """

    def __init__(self) -> None:
        self.stamps: list[int | None] = []
        self._periods: deque[int] = deque(maxlen=_PERIODS)

    def hides(self, stamp: int | None, since: int) -> bool:
        """Takes a packet's stamp; returns whether `since` pictures may be lost before it: from half a period more, or
        5 %."""
        last = self.stamps[-1] if self.stamps else None
        self.stamps.append(stamp)
        if stamp is None or last is None:
            return False
        period = sorted(self._periods)[len(self._periods) // 2] if self._periods else 0
        self._periods.append(stamp - last)
        return period > 0 and 0 < since <= 1.05 * ((stamp - last) / period - 1) + 0.5


class PacketDecoder:
    """Decodes the packets of one stream in their order, one picture each.

    Decoding begins with a key frame. A packet that cannot be decoded, since others are lost or it is damaged, gives no
    frame, nor do those after it until the next key frame: their pixels would be wrong. A packet that comes twice gives
    its frame twice. Frames depend on the packets since the key frame alone.

    `lost`: the reason why the last packet gave no frame; empty where it gave one.
    """

    def __init__(self, format_: str, max_pixels: int = 64_000_000) -> None:
        """`format_`: h264 or h265; `max_pixels`: a stream with larger pictures is refused."""
        self.format, self.max_pixels = format_, max_pixels
        self.lost = ""
        self._headers: Headers = _HEADERS[format_]()
        self._sets = b""
        self._capture: Capture | None = None
        self._group: list[bytes] | None = []
        """Packets since the key frame; None where they are more than are kept."""
        self._group_bytes = 0
        self._newest: NDArray[np.uint8] | None = None
        self._pace = Pace()

    def decode(self, data: bytes, stamp: int | None = None) -> NDArray[np.uint8] | None:
        """Returns the pixels (H, W, 3) of a packet, RGB; None where it cannot be decoded.

        `stamp`: its time (ns), by which losses show that the numbers of pictures hide; None: not known. Raises
        `VideoError` for a stream whose first key frame announces what is not decoded (B-frames, larger pictures); later
        on it is damage. TimeoutError where OpenCV hangs.
        """
        if self._group and data == self._group[-1]:
            return self._newest
        begun = bool(self._sets)
        try:
            picture = self._headers.read(data)
            if picture.pixels > self.max_pixels:
                raise VideoError(f"its pictures have {picture.pixels} pixels, more than max_pixels={self.max_pixels}")
        except VideoError as error:
            if not begun and not isinstance(error, PacketError):
                raise
            self._headers = _HEADERS[self.format]()
            self._headers.learn(self._sets)  # and not those that came with the damage
            return self._lose(str(error))
        new_sets = self._take_sets(picture)
        if picture.missing:
            return self._lose(picture.missing)
        try:
            return self._follow(data, picture, new_sets, stamp)
        except VideoError as error:  # of OpenCV
            return self._lose(str(error))

    def state(self) -> Mapping[str, Any] | None:
        """Returns a value from which `take_up` goes on alike; None where that were too many bytes."""
        if self._group is None:
            return None
        stamps = list(self._pace.stamps) if self._group else []
        return {
            "format": self.format,
            "sets": self._sets,
            "group": list(self._group),
            "stamps": stamps,
            "lost": self.lost,
        }

    def take_up(self, state: Mapping[str, Any]) -> None:
        """Takes over the `state` of another decoder of this format, by decoding its packets since the key frame."""
        self._headers.learn(state["sets"])
        self._sets = bytes(state["sets"])
        for packet, stamp in zip(state["group"], state["stamps"], strict=True):
            self.decode(packet, stamp)
        self.lost = str(state["lost"])

    def close(self) -> None:
        """Ends OpenCV's decoder. Idempotent."""
        if self._capture is not None:
            self._capture.close()
            self._capture = None

    def _take_sets(self, picture: Picture) -> bool:
        """Keeps the parameter sets of a packet; returns whether they are others than before."""
        if picture.sets in (b"", self._sets):
            return False
        self._sets = picture.sets if picture.whole else self._sets + picture.sets
        return True

    def _follow(self, data: bytes, picture: Picture, new_sets: bool, stamp: int | None) -> NDArray[np.uint8] | None:
        if picture.key:
            self._pace = Pace()
            self._pace.hides(stamp, picture.since)
            return self._begin(data if picture.whole else self._sets + data, new_sets)
        if self._capture is None:
            return self._lose(self.lost)
        if self._pace.hides(stamp, picture.since):
            return self._lose(f"a pause as long as that of {picture.since} pictures: a key frame may be lost in it")
        self._keep(data)
        return self._only(self._capture.feed(data))

    def _begin(self, packet: bytes, new_sets: bool) -> NDArray[np.uint8] | None:
        """Decodes a key frame, by a new decoder where pictures may have another form."""
        self._group, self._group_bytes = [], 0
        self._keep(packet)
        if self._capture is not None and not new_sets:
            return self._only(self._capture.feed(packet))
        self.close()
        self._capture = Capture(self.format, packet)
        return self._only([self._capture.first])

    def _keep(self, packet: bytes) -> None:
        if self._group is not None:
            self._group.append(packet)
            self._group_bytes += len(packet)
            if self._group_bytes > MAX_GROUP:
                self._group = None
        else:
            del self._pace.stamps[:-1]

    def _only(self, frames: list[NDArray[np.uint8]]) -> NDArray[np.uint8] | None:
        import cv2

        if len(frames) != 1:
            return self._lose(f"the decoder gave {len(frames)} frames for one packet: it is damaged")
        self.lost = ""
        self._newest = np.asarray(cv2.cvtColor(frames[0], cv2.COLOR_BGR2RGB), np.uint8)
        return self._newest

    def _lose(self, reason: str) -> NDArray[np.uint8] | None:
        """Waits for the next key frame; the first reason stands until then."""
        if self._capture is not None or not self.lost:
            self.lost = reason
        self._group = []
        self.close()
        return None
