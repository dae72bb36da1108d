"""A program written from docs/other-languages.md alone, which fails as its argument says in the first firing."""

import json
import struct
import sys
import time

import msgpack

FAULT = sys.argv[1]
REPLIES = {
    "text": b"hello from print()\n",
    "outcome": struct.pack("<BI", 7, 0),
    "frames": struct.pack("<BI", 0, 2**31),
    "size": struct.pack("<BII", 0, 1, 2**31),
    "half": struct.pack("<BIIB", 0, 1, 9, 1),
}


def read(size):
    data = sys.stdin.buffer.read(size)
    if len(data) < size:
        sys.exit(0)
    return data


def reply(data):
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


def envelope(port, stamp, schema, fields):
    head, body = msgpack.packb([port, 0, 0, stamp, 0, ""]), msgpack.packb([schema, fields, []])
    return struct.pack("<4sBBHI", b"\x9cDFE", 1, 1, len(head), len(body)) + head + body


def messages(*frames):
    reply(struct.pack("<BI", 0, len(frames)) + b"".join(struct.pack("<I", len(f)) + f for f in frames))


while True:
    kind, stamp, count = struct.unpack("<BqI", read(13))
    frames = [read(*struct.unpack("<I", read(4))) for _ in range(count)]
    if kind == 0:
        value = {name: json.loads(text) for name, _, text in (f.decode().partition("=") for f in frames)}["value"]
        reply(struct.pack("<BI", 0, 0) * (2 if FAULT == "unasked" else 1))
    elif kind == 1 and FAULT == "silent":
        time.sleep(600)
    elif kind == 1 and FAULT in REPLIES:
        reply(REPLIES[FAULT])
        if FAULT == "half":
            sys.exit(3)
    elif kind == 1 and FAULT == "garbage":
        messages(b"no envelope")
    elif kind == 1 and FAULT == "twice":
        messages(*[envelope("out", stamp, "Number", [value, ""])] * 2)
    elif kind == 1 and FAULT == "port":
        messages(envelope("other", stamp, "Number", [value, ""]))
    elif kind == 1:
        messages(envelope("out", stamp, "Number", [value, "m"]))
    elif kind == 5 or kind == 6:
        reply(struct.pack("<BI", 2, 0))
    else:
        messages()
    if FAULT == "stubborn" and kind == 2:
        time.sleep(600)
