"""The documented format is the real one: the examples of `docs/wire-format.md` are what the encoder writes."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import msgpack
import numpy as np
import pytest
from transport_envelopes import carrying

from dataflow.messages import DepthImage
from dataflow.transport import Envelope, Kind, decode, encode

STREAM = "robot1/camera/depth"
DEPTH = DepthImage(stamp=1_700_000_000_123_456_789, frame="camera", data=np.array([[0.5, 1.0], [0.0, 2.0]], np.float32))
EXAMPLES = {
    "message": carrying(DEPTH, STREAM, 5, wall=1_700_000_000_125_000_000),
    "frontier": Envelope(Kind.FRONTIER, STREAM, 0, 6, 1_700_000_000_156_789_122),
}


def documented(repository: Path, name: str) -> bytes:
    text = (repository / "docs" / "wire-format.md").read_text()
    found = re.search(rf"<!-- example: {name} -->\n```text\n(.*?)```", text, re.DOTALL)
    assert found is not None, f"docs/wire-format.md has no example {name!r}"
    return bytes.fromhex(re.sub(r"^[0-9a-f]+:", "", found[1], flags=re.MULTILINE))


def hex_dump(data: bytes) -> str:
    """Sixteen bytes a line, as the page shows them."""
    return "\n".join(f"{i:03x}: {data[i : i + 16].hex(' ')}" for i in range(0, len(data), 16))


@pytest.mark.parametrize("name", EXAMPLES)
def test_wire_format_examples_match_the_encoder(repository: Path, name: str) -> None:
    wire = encode(EXAMPLES[name])
    assert documented(repository, name) == wire, f"docs/wire-format.md should say\n{hex_dump(wire)}"
    assert decode(documented(repository, name)) == EXAMPLES[name]


def test_a_client_written_from_the_page_alone_reads_the_example(repository: Path) -> None:
    wire = documented(repository, "message")
    magic, version, kind, head_bytes, body_bytes = struct.unpack_from("<4sBBHI", wire)
    assert (magic.hex(), version, kind) == ("9c444645", 1, 1)
    stream, incarnation, seq, stamp, _, reason = msgpack.unpackb(wire[12 : 12 + head_bytes])
    assert (stream, incarnation, seq, stamp, reason) == (STREAM, 0, 5, DEPTH.stamp, "")
    end = 12 + head_bytes + body_bytes
    schema, header, [[dtype, shape]] = msgpack.unpackb(wire[12 + head_bytes : end])
    assert (schema, header, dtype, shape) == ("DepthImage", ["camera"], "<f4", [2, 2])
    start = (end + 63) // 64 * 64
    assert struct.unpack("<4f", wire[start:]) == (0.5, 1.0, 0.0, 2.0)
