"""A graph with a fake vision-language service on loopback: its answers are random, and some are errors or too late."""

from __future__ import annotations

import json
import random
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from dataflow.graph import Graph, load_text
from dataflow.messages import FeatureVector, Message, Text
from dataflow.operator import In, Operator, Out, Param, Source

PATIENCE = 0.1
"""Seconds that the operator waits for an answer."""


class _Service(BaseHTTPRequestHandler):
    """Answers with random words; one question in four with an error, one in four too late."""

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        fate = random.SystemRandom().random()
        if fate < 0.25:
            time.sleep(3 * PATIENCE)
        elif fate < 0.5:
            self.send_error(503, "busy")
            return
        words = {"seen": random.SystemRandom().choices(["door", "chair", "stairs"], k=3), "score": fate}
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps(words).encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Prints nothing."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that has gone away is expected."""


@contextmanager
def service() -> Iterator[str]:
    """Serves until the end of the block; gives the address."""
    with _Server(("127.0.0.1", 0), _Service) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def ask(url: str, prompt: str, pixels: np.ndarray) -> Any:
    """Asks the service. Raises `TimeoutError` and `urllib.error.HTTPError`."""
    body = json.dumps({"prompt": prompt, "pixels": pixels.tolist()}).encode()
    with urllib.request.urlopen(urllib.request.Request(url, body), timeout=PATIENCE) as reply:
        return json.load(reply)


class Views(Source):
    """Small grey images at 10 Hz."""

    view: Out[FeatureVector]
    views: int = Param(12, ge=1, doc="number of images")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.views):
            pixels = np.full((4, 4), k, np.float32)
            yield {"view": FeatureVector(stamp=10**18 + k * 100_000_000, vectors=pixels, model="grey")}


@dataclass
class State:
    failures: int = 0
    last: str = "nothing"


class Describe(Operator):
    """Describes images by the service; the last description stands in where that fails."""

    view: In[FeatureVector]
    text: Out[Text]
    url: str = Param(doc="address of the service")
    prompt: str = Param("What is in the way?", doc="the question")
    state: State

    def process(self, view: FeatureVector) -> Text:
        try:
            answer = self.effect(ask, self.url, f"{self.prompt} Not {self.state.last}.", view.vectors)
        except OSError as error:
            self.state.failures += 1
            return Text(stamp=view.stamp, text=f"{self.state.last} ({type(error).__name__}: {error})")
        self.state.last = " and ".join(sorted(set(answer["seen"])))
        return Text(stamp=view.stamp, text=f"{self.state.last} at {answer['score']:.3f}, {self.rng.random():.3f}")


def graph(url: str, views: int = 12, prompt: str = "What is in the way?") -> Graph:
    return load_text(
        f"""
graph: asking
record: {{snapshots: 400ms}}
operators:
  camera: {{use: 'vision_language:Views', params: {{views: {views}}}}}
  describe:
    use: 'vision_language:Describe'
    params: {{url: '{url}', prompt: '{prompt}'}}
    inputs: {{view: camera/view}}
"""
    )
