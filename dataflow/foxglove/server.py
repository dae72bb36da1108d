"""A WebSocket server that Foxglove connects to."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any, Protocol, Self

from dataflow.extras import missing_extra
from dataflow.foxglove.drawing import SchemaDrawing, data_of, drawing_of, schema_of
from dataflow.messages import Message
from dataflow.recording.streams.frames import FrameTree

FRAMES = "/frames"
LOOPBACK = "127.0.0.1"
BACKLOG = 256
"""Messages that wait for a client that is slow; then its oldest are dropped. Other clients do not wait."""


class Topics:
    """Names topics `/operator/port`, without the namespace, and derives the transforms that Foxglove cannot know."""

    def __init__(self, namespace: str = "") -> None:
        self._prefix = f"{namespace}/" if namespace else ""
        self._frames = FrameTree()

    def of(self, stream: str, message: Message) -> Iterator[tuple[str, Message]]:
        """Yields what is shown for a message: topic and message, its own last."""
        transforms = self._frames.transforms(stream, message)
        if transforms is not None:
            yield FRAMES, transforms
        yield f"/{stream.removeprefix(self._prefix).lstrip('/')}", message


class FoxgloveError(RuntimeError):
    """The server cannot be started; the message has the reason, and what to do."""


class Controls(Protocol):
    """Is moved by the playback bar of Foxglove."""

    def request(self, *, playing: bool, speed: float, seek: int | None) -> str | None:
        """Does what a client asks for; `seek`: the stamp to go to. Returns why it does not, where it does not."""

    def state(self) -> tuple[bool, int, float]:
        """Returns whether it plays, the stamp it is at, and its speed."""


class FoxgloveServer:
    """Shows messages to every Foxglove that is connected; one that is slow misses some. A context manager.

    Listens on this machine alone by default; `port` 0 takes a free one. With `controls` and the
    `span` of what they play (ns), Foxglove shows its playback bar. A panel that is opened later is given the newest
    message at once. Raises `FoxgloveError`.
    """

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "",
        host: str = LOOPBACK,
        port: int = 8765,
        controls: Controls | None = None,
        span: tuple[int, int] | None = None,
    ) -> None:
        self._sdk = _sdk()
        self._topics = Topics(namespace)
        self._context = self._sdk.Context()
        self._channels: dict[tuple[str, type[Message], SchemaDrawing | None], Any] = {}
        self._newest: dict[int, tuple[Any, Message]] = {}
        self._guard = threading.Lock()
        self.shown = 0
        capabilities = [self._sdk.Capability.Time]
        try:
            self._server = self._sdk.start_server(
                name=name,
                host=host,
                port=port,
                capabilities=capabilities,
                server_listener=_Listener(self._sdk, self._again, controls, self._refuse),
                context=self._context,
                playback_time_range=span if controls is not None else None,
                message_backlog_size=BACKLOG,
            )
        except (OSError, RuntimeError) as error:
            raise FoxgloveError(f"cannot listen on {host}:{port}: {error}; another --port may be free") from error
        self.address = f"ws://{host}:{self._server.port}"

    def show(self, stream: str, message: Message) -> None:
        """Sends a message, with the transforms that it implies, to its topic's subscribers. One thread calls it."""
        for topic, shown in self._topics.of(stream, message):
            key = (topic, type(shown), drawing_of(shown))
            channel = self._channels.get(key) or self._open(key, shown)
            with self._guard:  # never around what may wait for the server, whose threads take it too
                self._newest[channel.id()] = (channel, shown)
            if channel.has_sinks():
                channel.log(data_of(shown), log_time=max(shown.stamp, 0))
        self.shown += 1

    def time(self, stamp: int) -> None:
        """Sends the clients which time it is."""
        self._server.broadcast_time(max(stamp, 0))

    def playback(self, controls: Controls, *, did_seek: bool = False, ended: bool = False) -> None:
        """Sends the clients where the playback is."""
        self._server.broadcast_playback_state(_state(self._sdk, controls, did_seek, ended, ""))

    def _refuse(self, why: str) -> None:
        """Sends the clients why the playback bar did not do what it was asked for."""
        self._server.publish_status(why, self._sdk.websocket.StatusLevel.Warning, "playback")

    def close(self) -> None:
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, key: tuple[str, type[Message], SchemaDrawing | None], message: Message) -> Any:
        text, encoding = schema_of(message)
        schema = self._sdk.Schema(name=text.name, encoding=text.encoding, data=text.data)
        channel = self._sdk.Channel(key[0], schema=schema, message_encoding=encoding, context=self._context)
        self._channels[key] = channel
        return channel

    def _again(self, channel_id: int) -> None:
        """A client begins to look at a channel: it is given the newest message."""
        with self._guard:
            found = self._newest.get(channel_id)
        if found is not None:
            channel, message = found
            channel.log(data_of(message), log_time=max(message.stamp, 0))


class _Listener:
    """Is told by the server, on its threads, what clients do."""

    def __init__(
        self, sdk: Any, subscribed: Callable[[int], None], controls: Controls | None, refused: Callable[[str], None]
    ) -> None:
        self._sdk, self._subscribed, self._controls, self._refused = sdk, subscribed, controls, refused

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._subscribed(channel.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Does nothing: the server asks for it all the same, and reports where it is lacking."""

    def on_playback_control_request(self, request: Any) -> Any:
        if self._controls is None:
            return None
        playing = request.playback_command == self._sdk.websocket.PlaybackCommand.Play
        why = self._controls.request(playing=playing, speed=request.playback_speed, seek=request.seek_time)
        if why is not None:
            self._refused(why)
        moved = request.seek_time is not None and why is None
        return _state(self._sdk, self._controls, moved, False, request.request_id)


def _state(sdk: Any, controls: Controls, did_seek: bool, ended: bool, request: str) -> Any:
    playing, stamp, speed = controls.state()
    statuses = sdk.websocket.PlaybackStatus
    status = statuses.Ended if ended else statuses.Playing if playing else statuses.Paused
    return sdk.websocket.PlaybackState(status, max(stamp, 0), speed, did_seek, request)


def _sdk() -> Any:
    try:
        import foxglove
        import foxglove.websocket
    except ImportError as error:
        raise FoxgloveError(f"foxglove-sdk is not installed; {missing_extra(error)}") from error
    return foxglove
