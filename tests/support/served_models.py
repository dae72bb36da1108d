"""A server on loopback that serves one file, whole or in parts, and breaks connections off when told."""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from operators.models.registry import Model

CONTENT = bytes(range(256)) * 3000


@dataclass
class Served:
    """What the server does: `cuts` holds after how many bytes each of the next connections ends; then all is sent.

    `told`: whether it says how long an answer is.
    """

    url: str = ""
    content: bytes = CONTENT
    cuts: list[int] = field(default_factory=list)
    ranges: bool = True
    code: int = 200
    told: bool = True
    asked: list[str | None] = field(default_factory=list)


@contextmanager
def serving() -> Iterator[Served]:
    state = Served()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            state.asked.append(wanted)
            begin = int(re.match(r"bytes=(\d+)-", wanted)[1]) if wanted and state.ranges else 0
            if state.code != 200 or begin >= len(state.content):
                self.send_error(state.code if state.code != 200 else 416)
                return
            part = state.content[begin:]
            self.send_response(206 if begin else 200)
            if begin:
                self.send_header("Content-Range", f"bytes {begin}-{len(state.content) - 1}/{len(state.content)}")
            if state.told:
                self.send_header("Content-Length", str(len(part)))
            self.end_headers()
            self.wfile.write(part[: state.cuts.pop(0)] if state.cuts else part)

        def log_message(self, format: str, *args: object) -> None:
            """Prints nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_port}/net.onnx"
    yield state
    server.shutdown()
    server.server_close()
    thread.join(10)


def model_of(content: bytes, name: str = "net", **source: str) -> Model:
    """A row whose file has this content."""
    return Model.model_validate(
        {
            "name": name,
            "about": "a network",
            "task": "detection",
            "operator": "operators.detection:OnnxDetector",
            "input": "any",
            "licence": {"code": "MIT", "weights": "CC-BY-4.0"},
            "home": "here",
            "source": source,
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
            "published": "nothing",
        }
    )


def write_row(file: Path, row: Model, **fields: Any) -> str:
    """Writes a registry of one row, some of whose fields are others."""
    told = row.model_dump(exclude_none=True) | fields
    file.write_text(json.dumps({"models": {told.pop("name"): told}}))
    return str(file)
