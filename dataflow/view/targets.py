"""Targets of a viewer: a window, a viewer that runs, a page for browsers, a file. Nothing of Rerun is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from dataflow.view.process import LOOPBACK, ViewerError

GRPC_PORT = 9876
_WEB_PORT = 9090


@dataclass(frozen=True, slots=True)
class Spawn:
    """A window on this machine; it stays open when the program ends. Past `memory_limit` it forgets the oldest data."""

    port: int = GRPC_PORT
    memory_limit: str = "2GB"


@dataclass(frozen=True, slots=True)
class Connect:
    """A viewer that runs already, by its address: `rerun+http://127.0.0.1:9876/proxy`."""

    url: str = f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"


@dataclass(frozen=True, slots=True)
class Serve:
    """A page for browsers on this machine, as long as the sink is open. Latecomers get what fits in `memory_limit`."""

    web_port: int = _WEB_PORT
    grpc_port: int = GRPC_PORT
    memory_limit: str = "1GB"

    @property
    def url(self) -> str:
        """Returns what to open in the browser: dark, as colours of classes are chosen to be read on."""
        data = quote(f"rerun+http://{LOOPBACK}:{self.grpc_port}/proxy", safe="")
        return f"http://{LOOPBACK}:{self.web_port}/?url={data}&theme=dark"


@dataclass(frozen=True, slots=True)
class Save:
    """A file that Rerun opens; an existing one is replaced. `at_end`: it opens at its end instead of playing."""

    path: Path
    at_end: bool = False


Target = Spawn | Connect | Serve | Save


def parse_target(text: str) -> Target:
    """`spawn`, `serve`, `rerun+http://host:port/proxy`, or a path that ends in `.rrd`. Raises `ViewerError`."""
    if text in ("spawn", "serve"):
        return Spawn() if text == "spawn" else Serve()
    if text.startswith(("rerun://", "rerun+http://", "rerun+https://")):
        return Connect(text)
    if text.endswith(".rrd"):
        return Save(Path(text))
    raise ViewerError(
        f"viewer {text!r}: expected spawn, serve, rerun+http://HOST:PORT/proxy, or a file name ending in .rrd"
    )
