"""Messages of ROS types that have no counterpart here, as they came."""

from __future__ import annotations

from dataflow.messages import Message, array, scalar
from dataflow.messages.arrays import U8


class RosMessage(Message):
    """Holds a message of ROS 2 as it is on the wire."""

    type: str = scalar("str", "its ROS type, such as std_msgs/msg/String")
    hash: str = scalar("str", "hash of the type's definition (RIHS01); of Humble, TypeHashNotSupported")
    data: U8 = array("uint8", "N", "the message as CDR, with its encapsulation header")
