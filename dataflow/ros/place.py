"""The parameters that sources and sinks of ROS topics share."""

from __future__ import annotations

from typing import Any, Literal

from dataflow.operator import Param
from dataflow.ros.definitions import Distro
from dataflow.ros.node import ROUTER, Ros2Node
from dataflow.ros.wire import absolute

TOPIC = r"^~?/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*$"
"""Names that ROS takes."""
NAMESPACE = r"^/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*)?$"
NODE = r"^([A-Za-z_]\w*)?$"
ENDPOINT = r"^[a-z][a-z0-9_-]*/.+$"
"""Such as tcp/localhost:7447."""
TYPE = r"^(|[A-Za-z]\w*/msg/[A-Za-z]\w*)$"


class Place:
    """Names the topic of which ROS graph is meant, and with which quality of service."""

    topic: str = Param(pattern=TOPIC, doc="name of the topic; without a leading slash, it lies in the namespace")
    distro: Distro = Param("jazzy", doc="distribution whose definition of the type counts, where that is given")
    domain: int = Param(0, ge=0, doc="ROS_DOMAIN_ID")
    namespace: str = Param("/", pattern=NAMESPACE, doc="namespace of the node")
    node: str = Param("", pattern=NODE, doc="name of the node; none takes dataflow and the topic")
    router: str = Param(ROUTER, pattern=ENDPOINT, doc="Zenoh endpoint of the router to connect to")
    zenoh: dict[str, Any] = Param({}, doc="further Zenoh settings by path, such as of TLS")
    reliability: Literal["reliable", "best_effort"] = Param("reliable", doc="quality of service")
    durability: Literal["volatile", "transient_local"] = Param(
        "volatile", doc="transient_local: publishers keep messages for subscribers that come later"
    )
    depth: int = Param(10, ge=1, doc="messages that publishers keep (history)")

    def absolute(self, topic: str) -> str:
        """Returns the full name of a topic."""
        return absolute(topic, self.namespace)

    def join(self) -> Ros2Node:
        """Returns the node, connected. Raises SourceError."""
        name = self.node or "dataflow" + self.absolute(self.topic).replace("/", "_")
        return Ros2Node(name, self.namespace, self.domain, self.router, self.zenoh)
