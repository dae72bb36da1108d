"""Envelope codec and the Zenoh bus between hosts."""

from dataflow.transport.bus import Bus, BusError, StreamPublisher, Token
from dataflow.transport.codec import (
    DecodeError,
    Envelope,
    Head,
    Kind,
    Limits,
    decode,
    decode_head,
    encode,
    encode_into,
    encode_parts,
    encoded_size,
)
from dataflow.transport.network import NetworkConfig, NetworkError, reserve_endpoints
from dataflow.transport.registry import RegistryError, RunningGraph, register, running
from dataflow.transport.taps import TapClient, TapMessage, TapServer, TapWindow

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
    "encode_into",
    "encode_parts",
    "encoded_size",
    "register",
    "reserve_endpoints",
    "running",
]
