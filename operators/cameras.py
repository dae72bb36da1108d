"""Several cameras of one robot in one operator: which output is whose, and which images fit into one tensor."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TypeVar

from dataflow.messages import Image

T = TypeVar("T")


class Cameras:
    """Holds the output of each camera, by the frame of its images, in the order of the frames."""

    def __init__(self, frames: Sequence[str], ports: Sequence[str], where: str) -> None:
        """Raises ValueError where there is no frame, a frame is named twice, or there are more frames than outputs."""
        if not frames or len(set(frames)) != len(frames):
            raise ValueError(f"{where} must name the frame of each camera once, is {list(frames)}")
        if len(frames) > len(ports):
            raise ValueError(f"{where} names {len(frames)} cameras, but there are {len(ports)} outputs")
        self._ports = dict(zip(frames, ports, strict=False))
        self._where = where

    def by_port(self, images: Collection[Image]) -> dict[str, Image]:
        """Returns the images of one firing by output. Raises ValueError for one of an unknown camera, or two of one."""
        found: dict[str, Image] = {}
        for image in images:
            port = self._ports.get(image.frame)
            if port is None:
                raise ValueError(f"an image is in frame {image.frame!r}; {self._where} has {', '.join(self._ports)}")
            if port in found:
                raise ValueError(
                    f"two images of one stamp are in frame {image.frame!r}: each camera needs a separate frame"
                )
            found[port] = image
        return found


def same_size(images: Mapping[T, Image]) -> list[dict[T, Image]]:
    """Returns the images in groups of one size, which a network takes at once without borders around the smaller."""
    groups: dict[tuple[int, int], dict[T, Image]] = {}
    for key, image in images.items():
        groups.setdefault((image.width, image.height), {})[key] = image
    return list(groups.values())
