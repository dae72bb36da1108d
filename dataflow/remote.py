"""Sources of messages that come from outside the graph: by `dataflow pub`, a script, an operator's desk.

`use: dataflow.remote:Twist` is a source of Twist messages on its port `message`, and so for every type of
`dataflow.messages`. For a custom type, or another name of the port, subclass `Remote`:

    class Goals(Remote):
        goal: Out[Goal] = Out(doc="where to go")
"""

from __future__ import annotations

import queue
from collections.abc import Iterator, Mapping
from typing import Any, Final

import dataflow.messages as _messages
from dataflow.messages.base import Message, MessageError, message_type
from dataflow.operator import Out, Source
from dataflow.ports import OutputPort

MOST: Final = 256
"""Messages that wait to be emitted; more are refused."""


class Remote(Source, abstract=True):
    """Emits what it is given with `put`, by any thread. It has one port, and runs in live runs alone."""

    real_time = True

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        self._given: queue.Queue[Message | None] = queue.Queue(MOST)

    @property
    def port(self) -> OutputPort:
        """The port on which it emits. Raises `TypeError` for a class that has not declared exactly one."""
        ports = [port for port in self.spec.outputs.values() if not port.static]
        if len(ports) != 1:
            raise TypeError(f"{type(self).__name__} has {len(ports)} ports; a source of messages from outside has one")
        return ports[0]

    def put(self, message: Message) -> bool:
        """Hands a message over; False when too many wait."""
        try:
            self._given.put_nowait(message)
        except queue.Full:
            return False
        return True

    def stream(self) -> Iterator[Mapping[str, Message]]:
        name = self.port.name
        while (message := self._given.get()) is not None:
            yield {name: message}

    def stop_reading(self) -> None:
        """Lets `stream()` return; what still waits is left."""
        while True:
            try:
                self._given.put_nowait(None)
                return
            except queue.Full:
                self._given.get_nowait()


def __getattr__(name: str) -> type[Remote]:
    """The source of messages of a type of `dataflow.messages`, made when it is first asked for."""
    if name.startswith("_") or name not in _messages.__all__:
        raise AttributeError(f"module {__name__!r} has no source {name!r}; it has one for each message type")
    try:
        found = message_type(name)
    except MessageError:
        raise AttributeError(f"{name!r} is no message type") from None
    made = type(
        name,
        (Remote,),
        {
            "__module__": __name__,
            "__doc__": f"{name} messages from outside the graph: `dataflow pub`.",
            "__annotations__": {"message": Out[found]},  # type: ignore[valid-type]
            "message": Out(doc="what was published"),
        },
    )
    globals()[name] = made
    return made
