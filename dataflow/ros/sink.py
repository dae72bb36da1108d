"""The sink that gives streams to ROS 2 as topics over Zenoh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal, Union

from dataflow.interop.ros.to_ros2 import OUTWARD
from dataflow.messages import CameraInfo, Message, Transforms
from dataflow.operator import In, Operator, Param, Sampled, SourceError
from dataflow.ros.definitions import store_of, type_hash, written
from dataflow.ros.message import RosMessage
from dataflow.ros.node import Publisher
from dataflow.ros.place import TYPE, Place
from dataflow.ros.wire import Qos

if TYPE_CHECKING:
    Given = Message
else:
    Given = Union[(*OUTWARD, RosMessage)]


class Ros2Sink(Place, Operator):
    """Publishes a stream as a topic. A verification does not publish again.

    What stands beside it may be given to `fixed`: transforms that do not move, published once and kept for late
    subscribers; or the calibration of a camera, published with each image, at its stamp.
    """

    external = True

    message: In[Given] = In(doc="messages to publish")
    fixed: Sampled[Transforms | CameraInfo] = Sampled(required=False, doc="what is static, for `fixed_topic`")

    type: str = Param(
        "",
        pattern=TYPE,
        doc="its ROS type; none takes the usual one of the message. Given, the topic is there before a message is",
    )
    fixed_topic: str = Param("/tf_static", min_length=1, doc="topic of `fixed`")
    history: Literal["keep_last", "keep_all"] = Param(
        "keep_last", doc="keep_all: a reliable publisher waits for a slow network; keep_last drops then"
    )

    def setup(self) -> None:
        """Connects to the router. Raises SourceError."""
        self._publisher: Publisher | None = None
        self._beside: Publisher | None = None
        self._node = self.join()
        store_of(self.distro)  # takes a second, in which messages would be dropped
        hash_ = type_hash(self.type, self.distro) if self.type else None
        if hash_ is not None:
            self._publisher = self._advertise(self.type, hash_)
        elif self.type:
            raise SourceError(f"ROS 2 {self.distro} has no type {self.type!r} that is known here")

    def _advertise(self, type_: str, hash_: str) -> Publisher:
        reliable, latched = self.reliability == "reliable", self.durability == "transient_local"
        qos = Qos(reliable, latched, self.history == "keep_all", self.depth)
        return self._node.advertise(self.absolute(self.topic), type_, hash_, qos)

    def process(self, message: Message, fixed: Transforms | CameraInfo | None) -> None:
        type_, hash_, data = written(message, self.type, self.distro)
        if self._publisher is None:
            self._publisher = self._advertise(type_, hash_)
        if type_ != self._publisher.type:
            raise ValueError(f"{self.topic} is a topic of {self._publisher.type}, and a {type_} came")
        if fixed is not None:
            self._publish_beside(fixed, message.stamp)
        self._publisher.put(data)

    def _publish_beside(self, fixed: Transforms | CameraInfo, stamp: int) -> None:
        latched = isinstance(fixed, Transforms)
        if self._beside is not None and latched:
            return
        type_, hash_, data = written(fixed if latched else fixed.replace(stamp=stamp), "", self.distro)
        if self._beside is None:
            qos = Qos(transient_local=latched, depth=1 if latched else self.depth)
            self._beside = self._node.advertise(self.absolute(self.fixed_topic), type_, hash_, qos)
        self._beside.put(data)

    def summary(self) -> Mapping[str, float | int | str]:
        """Messages published."""
        found = [each for each in (getattr(self, "_publisher", None), getattr(self, "_beside", None)) if each]
        return {"sent": sum(each.sent for each in found)}

    def close(self) -> None:
        if hasattr(self, "_node"):
            self._node.close()
