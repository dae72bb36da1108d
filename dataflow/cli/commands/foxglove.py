"""`dataflow foxglove`: streams in Foxglove, live or from a recording."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running, say_followed
from dataflow.cli.support.arguments import (
    Clock,
    End,
    Start,
    Streams,
    chosen_streams,
    existing_recording,
    number,
    span,
    window,
)
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import err, fail, out, plural, say

if TYPE_CHECKING:
    from dataflow.client.playback import ReplayBar, Steering
    from dataflow.foxglove.server import Controls, FoxgloveServer
    from dataflow.recording import Recorded

PORT, LOCAL = 8765, "127.0.0.1"


@dataclass(frozen=True, slots=True)
class FoxgloveOptions:
    """The options of `dataflow foxglove`, in the order of its help."""

    port: Annotated[int, option("--port PORT", "Where to listen; 0: a free one.")] = PORT
    host: Annotated[str, option("--host ADDRESS", "The address to listen on; other machines need another.")] = LOCAL
    streams: Streams = None
    speed: Annotated[
        float, option("--speed FACTOR", "At first.", parser=number(0.01, 100, "a factor of real time"))
    ] = 1.0
    start: Start = None
    end: End = None
    clock: Clock = "auto"
    which: Running = THE_ONLY

    def server(
        self, name: str, namespace: str, controls: Controls | None, shown: tuple[int, int] | None
    ) -> FoxgloveServer:
        """The server of what is called `name`, which has `controls` where it can be played."""
        from dataflow.foxglove.server import FoxgloveServer

        return FoxgloveServer(name, namespace=namespace, host=self.host, port=self.port, controls=controls, span=shown)


def foxglove(
    options: FoxgloveOptions,
    recording: Annotated[
        Path | None, argument("RECORDING", "A recording or a bag. Without one: the running graph.")
    ] = None,
) -> None:
    """Serve a running graph or a recording to Foxglove.

    In Foxglove: Open connection, Foxglove WebSocket, and the address that is printed. Its playback bar plays the
    recording: pause, speed, any place. Where the running graph is a replay (`dataflow replay`), the bar pauses it and
    changes its speed; a jump is refused with the option that begins there, since operators hold what came before.
    Images, clouds, boxes, masks, tracks, trajectories, maps and the scene graph are
    sent as Foxglove's own schemas; a client can never slow the graph.

    Examples:

      dataflow foxglove
      dataflow foxglove run.mcap --start 5 --speed 0.5
      dataflow foxglove drive.bag
      dataflow foxglove --stream "camera/*" --port 9000
      dataflow foxglove --wait 10
    """

    if not 0 <= options.port < 65536:
        raise fail(f"--port {options.port}: expected 0 to 65535")
    if recording is not None:
        if options.which != THE_ONLY:
            raise fail("--graph and --wait are about a running graph; leave them out to play a recording")
        _play(existing_recording(recording), options)
    else:
        if (options.start, options.end, options.speed, options.clock) != (None, None, 1.0, "auto"):
            raise fail("--start, --end, --speed and --clock are about a recording; name one")
        _follow(options)


def _play(path: Path, options: FoxgloveOptions) -> None:
    from dataflow.cli.support.drawing import account_of, opened_streams, say_account
    from dataflow.foxglove import player
    from dataflow.recording.layout import RECORDING

    with opened_streams(path, options.clock) as opened:
        known = account_of(opened).lines()
        readable = [name for name, info in opened.streams.items() if info.message_type is not None]
        namespace = opened.metadata.get(RECORDING, {}).get("namespace", "")
        chosen = chosen_streams(options.streams, readable, namespace)
        whole = span(opened, chosen)
        if whole is None:
            raise fail(f"{path} holds no message of {', '.join(chosen) or 'a type that is known here'}")
        begin, finish = window(whole, options.start, options.end, path)
        last = whole[1] if finish is None else min(finish, whole[1])
        clock = player.Clock(begin or whole[0], last, speed=options.speed)
        with options.server(path.name, namespace, clock, (clock.first, last)) as server:
            _say_where(server)

            def show(recorded: Recorded) -> None:
                if recorded.stamp <= clock.last:
                    server.show(recorded.stream, recorded.message)
                    server.time(recorded.stamp)

            def arrived() -> None:
                server.playback(clock, did_seek=True)

            def ended() -> None:
                server.playback(clock, ended=True)
                say("at its end; the playback bar of Foxglove goes back, Ctrl-C ends")

            try:
                player.play(opened, chosen, clock, show, arrived=arrived, ended=ended)
            except KeyboardInterrupt:
                say("ended")
        say_account(opened, known)
    out.print(f"shown: {plural(server.shown, 'message')}")


def _follow(options: FoxgloveOptions) -> None:
    from dataflow.client.attach import graph_of, still_runs, tap
    from dataflow.client.playback import steering

    found = options.which.found()
    running = graph_of(found)
    chosen = chosen_streams(options.streams, running.streams, running.namespace)
    with ExitStack() as stack:
        bar = _bar(stack.enter_context(steering(found)))
        span_of_bar = None if bar is None else bar.span
        server = stack.enter_context(options.server(running.name, running.namespace, bar, span_of_bar))
        _say_where(server)
        say_followed(found)
        if bar is not None:
            say("a replay: the playback bar of Foxglove pauses it and changes its speed")
            stack.enter_context(_told(server, bar))
        clock = 0
        try:
            with tap(found, [f"/{stream}" for stream in chosen] if options.streams else ["**"]) as client:
                while (taken := client.take(timeout=0.5)) is not None or still_runs(found):
                    message = None if taken is None else taken.decode().message
                    if taken is None or message is None:
                        continue
                    server.show(taken.stream, message)
                    if message.stamp > clock:
                        clock = message.stamp
                        server.time(clock)
        except KeyboardInterrupt:
            say("ended")
        else:
            say("the graph has ended")
    out.print(f"shown: {plural(server.shown, 'message')}")


def _bar(steering: Steering) -> ReplayBar | None:
    """Finds what a playback bar moves, where a recording is played through the graph; None elsewhere."""
    from dataflow.client.attach import NotRunning
    from dataflow.client.playback import ReplayBar

    try:
        standing = steering.ask(None)
    except NotRunning:  # a live run has nothing to move
        return None
    return None if standing["replay"] is None else ReplayBar(steering, standing)


@contextmanager
def _told(server: FoxgloveServer, bar: ReplayBar) -> Iterator[None]:
    """Sends the clients meanwhile where the replay stands, about twice a second."""
    over = threading.Event()

    def tell() -> None:
        while not over.wait(0.5):
            bar.refresh()
            server.playback(bar, ended=bar.ended)

    teller = threading.Thread(target=tell, name="playback", daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join(5.0)


def _say_where(server: FoxgloveServer) -> None:
    err.print(Text(f"Foxglove: Open connection, Foxglove WebSocket, {server.address}"), soft_wrap=True)
