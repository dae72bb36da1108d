"""Decoder of H.264 and H.265, as recordings and network cameras carry them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from dataflow.messages import CompressedVideo, Diagnostics, Image, Level, Message
from dataflow.operator import In, Operator, Out, Param
from dataflow.video.bits import VideoError
from dataflow.video.decoder import PacketDecoder
from operators.status import counted_status


class VideoDecoder(Operator):
    """Decodes H.264 and H.265 to images, each packet as soon as it comes.

    Decoding begins with a key frame. Where packets before one are lost (by the numbers in their headers), or it is
    damaged, it gives no image, nor do those after it until the next key frame: each is counted, and marked as lost by a
    status. The images depend on the packets since the key frame alone, so they are the same from any cut there; a
    snapshot holds these packets. FFmpeg decodes with one thread (OpenCV, from memory), so that an image comes with its
    packet. Which pixels it gives may depend on its version. A stream whose first parameter sets announce B-frames is
    refused: its packets are not in the order of their stamps.
    """

    video: In[CompressedVideo] = In(doc="packets in the order of time, one picture each")
    image: Out[Image] = Out(doc="RGB pixels, of the same stamp and frame")
    status: Out[Diagnostics] = Out(
        doc="a warning for each picture that is lost, with the reason; OK with the next image"
    )

    max_pixels: int = Param(64_000_000, ge=1, doc="a stream with more pixels a picture is refused")

    # snapshot and restore are written out: the state is in FFmpeg, which takes it up from packets and may lack it

    def setup(self) -> None:
        self._decoder: PacketDecoder | None = None
        self._counts = Counter(decoded=0, lost=0)

    def process(self, video: CompressedVideo) -> Mapping[str, Message]:
        """Raises ValueError for a stream that begins with B-frames, or with pictures that are too large."""
        decoder = self._decoder_of(video.format)
        was_lost = bool(decoder.lost) or not self._counts.total()
        try:
            pixels = decoder.decode(video.data.tobytes(), video.stamp)
        except VideoError as error:
            raise VideoError(f"CompressedVideo at stamp {video.stamp} cannot be decoded: {error}") from error
        if pixels is None:
            self._counts["lost"] += 1
            if not was_lost:
                self.log.warning("pictures are lost until the next key frame: %s", decoder.lost)
            return {"status": self._status(video.stamp, decoder.lost)}
        self._counts["decoded"] += 1
        made: dict[str, Message] = {"image": Image(data=pixels)}
        if was_lost:
            made["status"] = self._status(video.stamp, "")
        return made

    def on_reset(self, input: str) -> None:
        """The recording begins anew: its packets do not follow on those before."""
        self.close()
        self._decoder = None

    def close(self) -> None:
        decoder: PacketDecoder | None = getattr(self, "_decoder", None)
        if decoder is not None:
            decoder.close()

    def snapshot(self) -> Mapping[str, Any] | None:
        state = None if self._decoder is None else self._decoder.state()
        if self._decoder is not None and state is None:
            return None
        return {"decoder": state, "counts": dict(self._counts)}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._counts = Counter({key: int(n) for key, n in state["counts"].items()})
        if state["decoder"] is not None:
            self._decoder_of(state["decoder"]["format"]).take_up(state["decoder"])

    def summary(self) -> Mapping[str, int]:
        return dict(self._counts)

    def _decoder_of(self, format_: str) -> PacketDecoder:
        if self._decoder is None or self._decoder.format != format_:
            self.close()
            self._decoder = PacketDecoder(format_, self.max_pixels)
        return self._decoder

    def _status(self, stamp: int, lost: str) -> Diagnostics:
        level = Level.WARN if lost else Level.OK
        return counted_status("video", stamp, lost or "decoding", level, self._counts)
