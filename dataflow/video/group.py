"""Keeps the packets of a stream of video since its last key frame, so that a file that begins now can be decoded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

from dataflow.messages import CompressedVideo
from dataflow.messages.base import Message
from dataflow.video.decoder import MAX_GROUP, is_key

T = TypeVar("T")


class Groups(Generic[T]):
    """The packets of each stream since its last key frame, as what is kept of each; messages of other types are none.

    Of more than `MAX_GROUP` bytes none are kept.
    """

    def __init__(self) -> None:
        self._packets: dict[str, list[T]] = {}
        self._bytes: dict[str, int] = {}
        self._incarnations: dict[str, int] = {}

    def begin(self, stream: str, message: Message, incarnation: int) -> None:
        """Lets go of the packets that a message follows, where it is a key frame or of another incarnation."""
        if isinstance(message, CompressedVideo):
            key = is_key(message.format, message.data.tobytes())
            if key or self._incarnations.get(stream) != incarnation:
                self._packets.pop(stream, None)
                self._incarnations[stream], self._bytes[stream] = incarnation, 0
            if key:
                self._packets[stream] = []

    def add(self, stream: str, message: Message, kept: T) -> None:
        """Takes the message behind the others of its stream. `kept`: what is kept of it."""
        if isinstance(message, CompressedVideo) and stream in self._packets:
            self._packets[stream].append(kept)
            self._bytes[stream] += message.data.nbytes
            if self._bytes[stream] > MAX_GROUP:
                del self._packets[stream]

    def __iter__(self) -> Iterator[tuple[str, T]]:
        """Stream and what is kept of each packet, those of a stream in order."""
        return ((stream, kept) for stream, packets in self._packets.items() for kept in packets)
