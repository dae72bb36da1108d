"""Relates streams to each other: which calibration to which image, which detections over which image. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from types import MappingProxyType

from dataflow.graph.model import Graph
from dataflow.graph.sections import PLACE_FRAMES, View
from dataflow.messages import (
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Detections2D,
    Image,
    Image16,
    Keypoints2D,
    Mesh,
    Message,
    Planes,
    PointCloud,
    RelativeDepth,
    SceneGraph,
    SegmentationMap,
    Tracks,
)
from dataflow.view.pacing import Pace

COLOR: tuple[type[Message], ...] = (Image, CompressedImage, CompressedVideo, Image16)
DEPTH: tuple[type[Message], ...] = (DepthImage, CompressedDepth, RelativeDepth)
OVERLAYS: tuple[type[Message], ...] = (Detections2D, Keypoints2D, SegmentationMap, Tracks)

HEAVY: tuple[type[Message], ...] = (*COLOR, *DEPTH, *OVERLAYS, PointCloud)
"""Types that make up nearly all of a file: images, what is drawn over them, and clouds."""

_IMAGES: tuple[type[Message], ...] = (*COLOR, *DEPTH, SegmentationMap)
_PICTURES = {type_.SCHEMA for type_ in _IMAGES}

_TRUTH = {"true", "truth", "groundtruth", "gt"}


@dataclass(frozen=True, slots=True)
class Camera:
    """One image stream, its calibration (None: it has none) and what is drawn over it."""

    image: str
    info: str | None
    depth: bool
    overlays: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Layout:
    """Relations between the streams of a viewer.

    - `streams`: the streams shown, sorted, with their types.
    - `cameras`: every image stream; colour before depth, then by name.
    - `planes`: stream → name of the image plane that its pixels lie in, for images, calibrations and overlays.
    - `static`: streams whose one message holds for all time.
    - `aside`: truth that is drawn but switched off: scenes, surfaces, and boxes where others are estimated.
    - `kept`: clouds whose points stay where they were seen.
    - `placing`: streams that are not shown, and of which only the frames that they place are taken.
    - `empty`: streams and the parts of theirs (`space`, `plot/NAME`) that have drawn nothing so far.
    - `panels`: the parts of the window that the graph asks for; none: all.
    """

    streams: Mapping[str, type[Message]] = field(default_factory=lambda: MappingProxyType({}))
    cameras: tuple[Camera, ...] = ()
    planes: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    static: frozenset[str] = frozenset()
    aside: frozenset[str] = frozenset()
    panels: tuple[str, ...] = ()
    kept: frozenset[str] = frozenset()
    placing: frozenset[str] = frozenset()
    empty: frozenset[tuple[str, str]] = frozenset()

    def of_type(self, *types: type[Message]) -> tuple[str, ...]:
        """The streams of some types, sorted."""
        return tuple(name for name, type_ in self.streams.items() if issubclass(type_, types))

    def pace(self, step: int) -> Pace:
        """The choice of what is drawn in a step of event time (ns). Kept and static streams are drawn whole.

        Video is decoded whole, and its visualiser chooses by the same steps.
        """
        chosen = frozenset(self.of_type(*HEAVY)) - frozenset(self.of_type(CompressedVideo))
        return Pace(step, chosen - self.static - self.kept)


def layout(
    streams: Mapping[str, type[Message]],
    graph: Graph | None = None,
    static: Iterable[str] = (),
    hidden: Iterable[str] = (),
) -> Layout:
    """The layout of `streams` (name → message type), less those that are hidden and those that only decode another.

    With a graph, what is drawn over an image is found by walking the graph upstream; without one, by the words that
    names share. `static` and `hidden` add to those of the graph.
    """
    view = View() if graph is None else graph.view
    hidden = {*hidden, *view.hide}
    placing = frozenset(name for name, type_ in streams.items() if name in hidden and type_.SCHEMA in PLACE_FRAMES)
    shown = {name: streams[name] for name in sorted(streams) if name not in hidden}
    copies = _decoded(shown, graph) if graph is not None else {}
    shown = {name: type_ for name, type_ in shown.items() if name not in copies}
    fixed = {*static, *(graph.static if graph is not None else ())} & (shown.keys() | placing)

    images = [name for name, type_ in shown.items() if issubclass(type_, COLOR)]
    depths = [name for name, type_ in shown.items() if issubclass(type_, DEPTH)]
    infos = [name for name, type_ in shown.items() if issubclass(type_, CameraInfo)]
    info_of = {name: _calibration(name, infos, images + depths, graph) for name in images + depths}

    over: dict[str, list[str]] = {name: [] for name in images + depths}
    planes = {info: plane_name(info) for info in infos}
    planes |= {name: plane_name(info or name) for name, info in info_of.items()}
    for name, type_ in shown.items():
        if issubclass(type_, OVERLAYS) and (image := _image_under(name, images, depths, graph, copies)) is not None:
            over[image].append(name)
            planes[name] = planes[image]
    cameras = tuple(
        Camera(name, info_of[name], depth=name in depths, overlays=tuple(over[name])) for name in images + depths
    )
    return Layout(
        streams=MappingProxyType(shown),
        cameras=cameras,
        planes=MappingProxyType(planes),
        static=frozenset(fixed),
        aside=_aside(shown, graph),
        panels=view.panels,
        kept=frozenset(view.keep),
        placing=placing,
    )


def plane_name(stream: str) -> str:
    """The frame that stands for an image plane: named for the calibration, or for the image where there is none."""
    return f"image:{stream}"


def is_truth(stream: str) -> bool:
    """Returns whether a stream is ground truth by its name (`true`, `truth`, `ground_truth`, `gt`)."""
    return bool(_TRUTH & set(_words(stream)))


def _calibration(image: str, infos: list[str], images: list[str], graph: Graph | None) -> str | None:
    """The calibration of an image: of the same operator, else of an image it was made from, else of the same device.

    What an operator makes of no image, such as a plot, is no camera's and has none."""
    if graph is not None and _drawn(image, graph):
        return None
    operator, _, port = image.rpartition("/")
    near = [info for info in infos if info.rpartition("/")[0] == operator]
    if not near and graph is not None:
        for stream in _upstream(image, graph):
            if stream in images:
                return _calibration(stream, infos, images, graph)
            if stream in infos:
                return stream
    if not near:
        shared = {info: _common(info.split("/")[:-1], image.split("/")[:-1]) for info in infos}
        near = [info for info in infos if shared[info] == max(shared.values()) and shared[info] > 0]
        if not near and len(infos) == 1:
            near = infos
    return max(near, key=lambda info: (_likeness(info.rpartition("/")[2], port), -len(info)), default=None)


def _drawn(image: str, graph: Graph) -> bool:
    """Returns whether an operator makes an image of messages none of which is an image."""
    if image not in graph.streams:
        return False
    taken = graph.producer(image)[0].taken
    made = {name for stream in taken & graph.streams.keys() for name in graph.streams[stream].types}
    return bool(taken) and taken <= graph.streams.keys() and not made & _PICTURES


def _decoded(shown: Mapping[str, type[Message]], graph: Graph) -> dict[str, str]:
    """The images that operators decode from a compressed one that is shown too: stream → the compressed one."""
    found = {}
    for name, type_ in shown.items():
        family = COLOR if issubclass(type_, COLOR) else DEPTH if issubclass(type_, DEPTH) else ()
        if name not in graph.streams or not family or issubclass(type_, family[1]):
            continue
        taken = [stream for streams in graph.producer(name)[0].inputs.values() for stream in streams]
        if len(taken) == 1 and issubclass(shown.get(taken[0], Message), family[1]):
            found[name] = taken[0]
    return found


def _aside(shown: Mapping[str, type[Message]], graph: Graph | None) -> frozenset[str]:
    """The streams of truth that would hide what is estimated: what a source gives, or what is named so."""

    def given(stream: str) -> bool:
        from_source = graph is not None and stream in graph.streams and graph.producer(stream)[0].source
        return from_source or is_truth(stream)

    scenes = [name for name, type_ in shown.items() if issubclass(type_, SceneGraph | Planes | Mesh)]
    boxes = [name for name, type_ in shown.items() if issubclass(type_, Boxes3D)]
    estimated = any(not given(name) for name in boxes)
    return frozenset(name for name in scenes + (boxes if estimated else []) if given(name))


def _image_under(
    overlay: str, images: list[str], depths: list[str], graph: Graph | None, copies: Mapping[str, str]
) -> str | None:
    """The image that an overlay was made from."""
    if graph is not None:
        made_from = [copies.get(stream, stream) for stream in _upstream(overlay, graph)]
        found = next((s for s in made_from if s in images), None) or next((s for s in made_from if s in depths), None)
        if found is not None:
            return found
    candidates = images or depths
    return max(candidates, key=lambda image: (_likeness(image, overlay), -candidates.index(image)), default=None)


def _upstream(stream: str, graph: Graph) -> Iterable[str]:
    """The streams that `stream` is made from, nearest first."""
    if stream not in graph.streams:
        return
    queue, seen = [stream], {stream}
    while queue:
        node, _ = graph.producer(queue.pop(0))
        for taken in node.inputs.values():
            for name in taken:
                if name not in seen:
                    seen.add(name)
                    yield name
                    if name in graph.streams:
                        queue.append(name)


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^0-9a-z]+", name.lower()) if word]


def _common(a: Sequence[str], b: Sequence[str]) -> int:
    """Returns how many leading elements two sequences share."""
    return len([*takewhile(lambda pair: pair[0] == pair[1], zip(a, b, strict=False))])


def _likeness(a: str, b: str) -> tuple[int, int]:
    """Returns how much two names share: words, then leading letters."""
    return len(set(_words(a)) & set(_words(b))), _common(a, b)
