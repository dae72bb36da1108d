"""Messages of the Debug Adapter Protocol over a socket: `Content-Length` headers and JSON."""

from __future__ import annotations

import json
import select
import socket
from collections.abc import Mapping
from itertools import count
from typing import Any

MOST_BYTES = 2**24
"""Of a request."""
FIELDS = {b"Content-Length", b"Content-Type"}
"""Of the head of a message; the head of a page's request has others."""


class EditorDisconnected(ConnectionError):
    """Raised where the editor has left, or sends something else."""


class Wire:
    """One editor. https://microsoft.github.io/debug-adapter-protocol/specification"""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._read = connection, b""
        self._numbers = count(1)

    def request(self, *, wait: bool) -> Mapping[str, Any] | None:
        """Returns the next request; None where none is there, unless it waits. Raises `EditorDisconnected`."""
        while (found := self._parsed()) is None:
            if not wait and not select.select([self._connection], [], [], 0)[0]:
                return None
            try:
                more = self._connection.recv(2**16)
            except OSError as error:
                raise EditorDisconnected(str(error)) from error
            if not more:
                raise EditorDisconnected("the editor has closed the connection")
            self._read += more
        return found

    def answer(self, request: Mapping[str, Any], body: Mapping[str, Any] | None = None, error: str = "") -> None:
        """Sends the response to a request; with `error` it has failed. Raises `EditorDisconnected`."""
        told = {"request_seq": request["seq"], "command": request["command"], "success": not error}
        self._send("response", told | ({"message": error} if error else {"body": body or {}}))

    def event(self, name: str, **body: Any) -> None:
        """Sends an event. Raises `EditorDisconnected`."""
        self._send("event", {"event": name, "body": body})

    def _send(self, kind: str, content: Mapping[str, Any]) -> None:
        data = json.dumps({"seq": next(self._numbers), "type": kind, **content}).encode()
        try:
            self._connection.sendall(b"Content-Length: %d\r\n\r\n%s" % (len(data), data))
        except OSError as error:
            raise EditorDisconnected(str(error)) from error

    def _parsed(self) -> Mapping[str, Any] | None:
        head, found, rest = self._read.partition(b"\r\n\r\n")
        if not found:
            if len(head) > MOST_BYTES:
                raise EditorDisconnected("no header of the Debug Adapter Protocol")
            return None
        try:
            fields = dict(line.split(b":", 1) for line in head.split(b"\r\n"))
            if not fields.keys() <= FIELDS:
                raise ValueError(f"a head of {sorted(fields)}")
            length = int(fields[b"Content-Length"])
            if not 0 < length <= MOST_BYTES:
                raise ValueError(f"{length} bytes")
            if len(rest) < length:
                return None
            self._read = rest[length:]
            request = json.loads(rest[:length])
            if not isinstance(request["command"], str) or not isinstance(request["seq"], int):
                raise TypeError("command or seq")
        except (ValueError, KeyError, TypeError) as error:
            raise EditorDisconnected(f"no message of the Debug Adapter Protocol: {error!r}") from error
        return request  # type: ignore[no-any-return]
