"""Small operators that the graph tests wire; imported as `graph_operators`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal

from dataflow.messages.base import Message, array, scalar
from dataflow.operator import Batch, Duration, In, Operator, Out, Param, Sampled, Source


class Picture(Message, schema="TestPicture"):
    width: int = scalar("int", "columns", default=0)


class Depth(Message, schema="TestDepth"):
    values = array("float32", "N", "metres", optional=True)


class Lens(Message, schema="TestLens"):
    focal: float = scalar("float", "pixels", default=1.0)


class Cloud(Message, schema="TestCloud"):
    pass


class ColourCloud(Cloud, schema="TestColourCloud"):
    pass


class Pose(Message, schema="TestPose"):
    pass


class Camera(Source):
    """Makes pictures, depth and one lens."""

    image: Out[Picture] = Out(doc="left picture")
    depth: Out[Depth]
    info: Out[Lens] = Out(static=True)
    rate: float = Param(30.0, gt=0, unit="Hz", doc="pictures a second")
    path: str = Param("", doc="folder to read")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        yield {"image": Picture(stamp=0)}


class Device(Camera):
    """A camera that does not wait."""

    real_time = True


class CloudBuilder(Operator):
    """Makes a cloud of a depth image."""

    depth: In[Depth] = In(doc="depth image")
    image: In[Picture]
    camera: Sampled[Lens]
    cloud: Out[ColourCloud]
    stride: int = Param(2, ge=1, doc="keep every stride-th pixel")
    mode: Literal["fast", "exact"] = Param("fast", doc="how to interpolate")
    tag: str = Param("", doc="a word")
    window: Duration = Param(0, doc="how far back")

    def process(self, depth: Depth, image: Picture, camera: Lens) -> None:
        return None


class Detector(Operator):
    """Needs a model."""

    image: In[Picture]
    found: Out[Pose]
    model: str = Param(doc="ONNX file")
    threshold: float = Param(0.5, ge=0, le=1, doc="least score kept")
    options: dict[str, float] = Param({}, doc="further options")
    labels: list[str] = Param([], doc="names")

    def process(self, image: Picture) -> None:
        return None


class Odometry(Operator):
    """Tracks against a map it is fed back."""

    image: In[Picture]
    map: Sampled[Cloud] = Sampled(before=True, required=False)
    hint: Sampled[Pose] = Sampled(required=False)
    pose: Out[Pose]

    def process(self, image: Picture, map: Cloud | None, hint: Pose | None) -> None:
        return None


class Mapper(Operator, tolerance="20ms"):
    """Joins clouds and poses into a map."""

    cloud: In[Cloud]
    pose: In[Pose]
    map: Out[Cloud]

    def process(self, cloud: Cloud, pose: Pose) -> None:
        return None


class Echo(Operator):
    """A pose from a pose: for making cycles."""

    pose: In[Pose]
    hint: Sampled[Pose] = Sampled(required=False)
    echo: Out[Pose]

    def process(self, pose: Pose, hint: Pose | None) -> None:
        return None


class Fuse(Operator, merge=True):
    """Merges any number of poses."""

    poses: In[Pose] = In(many=True)
    fused: Out[Pose]

    def process(self, poses: Mapping[str, Pose]) -> None:
        return None


class Watchdog(Operator, every="100ms"):
    """Ticks."""

    lens: Sampled[Lens] = Sampled(required=False)
    poses: Batch[Pose] = Batch(many=True)

    def process(self, lens: Lens | None, poses: tuple[Pose, ...]) -> None:
        return None


class Log(Operator):
    """Takes pictures of any number of cameras."""

    images: In[Picture] = In(many=True)

    def process(self, images: Mapping[str, Picture]) -> None:
        return None


class Abstract(Operator, abstract=True):
    """Declares no ports."""


class NotAnOperator:
    """Just a class."""


class StaticUser(Operator):
    """Wants to be triggered by a lens."""

    lens: In[Lens]

    def process(self, lens: Lens) -> None:
        return None


class Ticker(Operator, every="1s"):
    """Ticks beside a lens."""

    lens: Sampled[Lens]

    def process(self, lens: Lens) -> None:
        return None
