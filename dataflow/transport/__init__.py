"""Envelope codec, links between processes of one machine, and the Zenoh bus to everything outside."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from dataflow.transport.bus import Bus, Token
    from dataflow.transport.codec import decode, decode_head, encode, encode_parts
    from dataflow.transport.envelope import DecodeError, Envelope, Head, Kind, Limits
    from dataflow.transport.fanout import Fanout
    from dataflow.transport.links import Incoming, Outgoing
    from dataflow.transport.network import NetworkConfig, NetworkError
    from dataflow.transport.outside import OutsidePublisher
    from dataflow.transport.publisher import BusError, Counters, StreamPublisher
    from dataflow.transport.registry import RegistryError, Reservation, RunningGraph, register, running
    from dataflow.transport.ring import make_ring
    from dataflow.transport.shared import PoolReader, make_board
    from dataflow.transport.tap_client import TapClient, TapMessage
    from dataflow.transport.tap_server import TapServer
    from dataflow.transport.taps import TapWindow
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "bus": ("Bus", "Token"),
            "codec": ("decode", "decode_head", "encode", "encode_parts"),
            "envelope": ("DecodeError", "Envelope", "Head", "Kind", "Limits"),
            "fanout": ("Fanout",),
            "links": ("Incoming", "Outgoing"),
            "network": ("NetworkConfig", "NetworkError"),
            "outside": ("OutsidePublisher",),
            "publisher": ("BusError", "Counters", "StreamPublisher"),
            "registry": ("RegistryError", "Reservation", "RunningGraph", "register", "running"),
            "ring": ("make_ring",),
            "shared": ("PoolReader", "make_board"),
            "tap_client": ("TapClient", "TapMessage"),
            "tap_server": ("TapServer",),
            "taps": ("TapWindow",),
        },
    )

__all__ = [
    "Bus",
    "BusError",
    "Counters",
    "DecodeError",
    "Envelope",
    "Fanout",
    "Head",
    "Incoming",
    "Kind",
    "Limits",
    "NetworkConfig",
    "NetworkError",
    "Outgoing",
    "OutsidePublisher",
    "PoolReader",
    "RegistryError",
    "Reservation",
    "RunningGraph",
    "StreamPublisher",
    "TapClient",
    "TapMessage",
    "TapServer",
    "TapWindow",
    "Token",
    "decode",
    "decode_head",
    "encode",
    "encode_parts",
    "make_board",
    "make_ring",
    "register",
    "running",
]
