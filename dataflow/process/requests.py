"""Answers requests from outside the graph: for parameters of operators, and for how the process fares."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import msgpack

from dataflow.execution.driver import Driver, Maker
from dataflow.execution.feeds.playback import Action
from dataflow.execution.source import SourceRunner
from dataflow.graph.code import ReloadError, code_now, file_digests
from dataflow.operator import is_tunable
from dataflow.process.channel import Channel
from dataflow.process.config import ProcessConfig
from dataflow.process.live_sources import LiveSources
from dataflow.process.progress import Progress
from dataflow.process.streams.inbox import Inbox
from dataflow.process.streams.recent import RecentFirings
from dataflow.remote import Remote
from dataflow.transport import Bus
from dataflow.transport.codec import decode
from dataflow.transport.keys import local_key, runtime_key

LIVE = "it is a live run: devices and the clock do not wait; runs without --live, and replays, can be paused"


class Requests:
    """Takes requests on Zenoh's thread; changes parameters on the main thread, between two firings."""

    def __init__(
        self,
        config: ProcessConfig,
        driver: Driver,
        live: LiveSources,
        progress: Progress,
        recent: RecentFirings,
        event_clock: Callable[[], int],
        channel: Channel,
    ) -> None:
        self._config, self._driver, self._live = config, driver, live
        self._progress, self._recent, self._event_clock = progress, recent, event_clock
        self._feeding, self._channel = driver.feeding, channel
        self._given: dict[str, int] = {}
        """The last stamp that each source was given from outside."""

    def serve(self, bus: Bus, namespace: str, inbox: Inbox) -> None:
        """Declares what is answered."""
        for name in self._config.nodes:
            bus.serve(runtime_key(namespace, "param", name), _to_inbox(inbox, name))
            bus.serve(local_key(namespace, "reload", name), _to_inbox(inbox, name, "reload"))
        for maker in self._driver.sources:
            if isinstance(maker.source, Remote):
                bus.serve(runtime_key(namespace, "pub", maker.node.name), partial(self.answer_publication, maker))
        bus.serve(runtime_key(namespace, "status", self._config.label), self._answer_status)
        bus.serve(runtime_key(namespace, "trigger", self._config.label), self._answer_trigger)
        if self._feeding.feeds or self._driver.sources:
            bus.serve(runtime_key(namespace, "playback"), _to_inbox(inbox, "", "playback"))

    def play(self, action: Action, steps: int = 1, speed: float | None = None) -> None:
        """Pauses, resumes, steps, or changes the speed, and reports it to the supervisor. Raises `ValueError`."""
        if not self._feeding.feeds:
            return
        self._feeding.play(action, steps, speed)
        playback = self._feeding.playback
        self._channel.send("playback", paused=playback.paused, speed=playback.speed)

    def answer_parameter(self, name: str, query: Any, *, here: bool = False) -> None:
        """Answers a request to change a parameter with the value as validated, or with an error.

        A request `{"get": true}` is answered with the values of all, and whether they can change now; with
        `{"reload": true}`, from `here` alone, the operator goes on with its code as it is in its files now
        (`Runner.reload`); with `"files": true` besides, these are only looked at (`file_digests`).
        """
        with _answering(query, operator=name) as answer:
            asked = msgpack.unpackb(query.payload.to_bytes(), raw=False)
            if asked.get("reload") and not here:
                raise ValueError("only a tool of this machine can have code loaded again")
            answer["value"] = self._value_asked(self._driver[name], asked)

    def answer_playback(self, query: Any) -> None:
        """Answers a request to pause, resume, step, or change the speed of what this process reads; one without an
        action asks how it stands."""
        with _answering(query) as answer:
            feeding = self._feeding
            asked = msgpack.unpackb(query.payload.to_bytes(), raw=False) if query.payload is not None else {}
            if not feeding.feeds:
                raise ValueError(LIVE)
            if "action" in asked:
                speed = asked.get("speed")
                self.play(asked["action"], int(asked.get("steps", 1)), None if speed is None else float(speed))
            playback = feeding.playback
            answer |= {"paused": playback.paused, "ended": feeding.ended, "speed": playback.speed}
            answer |= {"stamp": feeding.last, "replay": self._replayed()}

    def _replayed(self) -> dict[str, Any] | None:
        """Returns from when to when a recording is played, and the stamp that `--start` counts from."""
        spans = [span for log in self._feeding.logs if (span := log.span()) is not None]
        if self._config.replay is None or not spans:
            return None
        return {"span": list(spans[0]), "first": self._config.replay["first"]}

    def answer_publication(self, maker: SourceRunner, query: Any) -> None:
        """Takes an envelope from outside for a source that is made for it; on Zenoh's thread.

        A message with the stamp 0 is given the event time of now. A request without payload is answered with the port
        and the type that the source takes.
        """
        source = maker.source
        assert isinstance(source, Remote)
        types = [type_.SCHEMA for type_ in source.port.types]
        with _answering(query, operator=maker.node.name, port=source.port.name, types=types) as answer:
            if payload := b"" if query.payload is None else query.payload.to_bytes():
                answer["stamp"] = self._publish(maker, source, payload)

    def _publish(self, maker: SourceRunner, source: Remote, payload: bytes) -> int:
        """Hands a message to its source; returns its stamp. Raises `DecodeError`, `ValueError`."""
        message = decode(payload).message
        if message is None or not isinstance(message, source.port.types):
            raise ValueError(f"expected a {source.port.type_text()}")
        last = max(self._given.get(maker.node.name, maker.last), maker.last)
        if message.stamp == 0:
            message = message.replace(stamp=max(self._event_clock(), last + 1))
        elif message.stamp <= last:
            raise ValueError(f"the stamp {message.stamp} is not above {last}, the last one on this stream")
        if maker.ended or not source.put(message):
            raise ValueError("the source has ended" if maker.ended else "too many messages wait to be emitted")
        self._given[maker.node.name] = message.stamp
        return message.stamp

    def _value_asked(self, maker: Maker, asked: Any) -> Any:
        if asked.get("reload") and asked.get("files"):
            return file_digests(code_now(type(maker.operator)).texts)
        if asked.get("reload"):
            try:
                outcome = maker.reload()
            except ReloadError as error:  # the caller may no longer wait
                text = "is not reloaded, the old code goes on: %s"
                logging.getLogger(__name__).warning(text, error, extra={"operator": maker.node.name})
                raise
            self._channel.send("reloaded", operator=maker.node.name, **outcome)
            return outcome
        if asked.get("get"):
            fields = maker.operator.spec.parameters.model_fields
            values = maker.operator.params.model_dump(mode="json")
            return {n: {"value": values[n], "tunable": is_tunable(field)} for n, field in fields.items()}
        return maker.set_parameter(asked["name"], asked["value"])

    def _answer_status(self, query: Any) -> None:
        """Answers with what was reported last; on Zenoh's thread, so an operator at work holds up nothing.

        A request `{"firings": true}` is answered with the firing records of the last seconds too, `{"after": {process:
        cursor}}` with those behind the cursor of this process (`RecentFirings.after`).
        """
        with query:
            status: dict[str, Any] = {
                "process": self._config.label,
                "counts": self._progress.counted,
                "waits": self._progress.waited,
                "behind": self._progress.behind,
                "silences": self._progress.silences(),
                "found": {name: text for name, text in self._progress.found.items() if text},
                "restarts": self._restarts(),
                "ended": [maker.node.name for maker in self._driver.all if maker.ended],
            }
            asked = _asked(query)
            if asked.get("firings"):
                status["firings"] = self._recent.batches()
            if isinstance(cursors := asked.get("after"), dict):
                status["after"] = self._recent.after(cursors.get(self._config.label, {}))
            query.reply(query.key_expr, msgpack.packb(status))

    def _answer_trigger(self, query: Any) -> None:
        """Forwards a request to keep the history; on Zenoh's thread, so an operator at work delays nothing."""
        with _answering(query):
            asked = msgpack.unpackb(query.payload.to_bytes(), raw=False)
            self._channel.send("trigger", id=str(asked["id"]), text=str(asked["text"]))

    def _restarts(self) -> dict[str, int]:
        """Returns how often each operator was restarted, by this process and in the processes before it."""
        here = {maker.node.name: self._live.restarts_of(maker.node.name) for maker in self._driver.sources}
        here |= {runner.node.name: runner.restarted for runner in self._driver.operators}
        return {name: self._config.resumed(name).restarts + times for name, times in here.items()}


@contextmanager
def _answering(query: Any, **about: Any) -> Iterator[dict[str, Any]]:
    """Replies with what the block puts into the answer, or with why that failed; either way with what it is about."""
    answer: dict[str, Any] = {**about, "ok": True}
    with query:
        try:
            yield answer
        except (KeyError, TypeError, ValueError, AttributeError, msgpack.UnpackException) as error:
            answer = {**about, "ok": False, "error": str(error)}
        query.reply(query.key_expr, msgpack.packb(answer))


def _asked(query: Any) -> dict[str, Any]:
    payload = b"" if query.payload is None else query.payload.to_bytes()
    try:
        asked = msgpack.unpackb(payload, raw=False) if payload else {}
    except (ValueError, msgpack.UnpackException):  # the answer to an invalid request has the rest
        return {}
    return asked if isinstance(asked, dict) else {}


def _to_inbox(inbox: Inbox, name: str, kind: str = "param") -> Callable[[Any], None]:
    put = inbox.put

    def asked(query: Any) -> None:
        put((kind, name, query))

    return asked
