"""Envelope codec and the Zenoh bus between processes."""

from dataflow.transport.bus import Bus, Token
from dataflow.transport.codec import decode, decode_head, encode, encode_parts
from dataflow.transport.envelope import DecodeError, Envelope, Head, Kind, Limits
from dataflow.transport.network import NetworkConfig, NetworkError
from dataflow.transport.publisher import BusError, StreamPublisher
from dataflow.transport.registry import RegistryError, RunningGraph, register, running
from dataflow.transport.seal import new_secret
from dataflow.transport.sockets import Reservation, reserve_endpoints
from dataflow.transport.tap_client import TapClient, TapMessage
from dataflow.transport.tap_server import TapServer
from dataflow.transport.taps import TapWindow

__all__ = [
    "Bus",
    "BusError",
    "DecodeError",
    "Envelope",
    "Head",
    "Kind",
    "Limits",
    "NetworkConfig",
    "NetworkError",
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
    "new_secret",
    "register",
    "reserve_endpoints",
    "running",
]
