"""The processes of a run on one machine: started, listened to, signalled and buried, by the supervisor or its agent.

Their news are fed on as events, orders come as calls. Nothing here waits, but `bury`.
"""

from __future__ import annotations

import contextlib
import selectors
import signal
from collections.abc import Callable, Mapping
from typing import Any

from dataflow.process.channel import ChannelClosed
from dataflow.supervision.black_boxes import Boxes
from dataflow.supervision.core import events
from dataflow.supervision.links import Links
from dataflow.supervision.nursery import Child, ChildExited, Nursery, NurseryFailed

NOT_READING_AFTER = 1.0
"""Seconds for which a process may leave what was sent to it, before the core is notified."""


class Children:
    """The processes here by label. `feed` takes events, `printed` the lines that a process prints.

    `apart`: by label the nurseries of processes that another one than `nursery` starts.
    """

    def __init__(
        self,
        nursery: Nursery,
        apart: Mapping[str, Nursery],
        selector: selectors.BaseSelector,
        links: Links,
        boxes: Boxes,
        clock: Callable[[], float],
        feed: Callable[[events.Event], None],
        printed: Callable[[str, str], None],
    ) -> None:
        self._nursery, self._apart, self._selector, self._links, self._boxes = nursery, apart, selector, links, boxes
        self._clock, self._feed, self._printed = clock, feed, printed
        self._children: dict[str, Child] = {}
        self._taken_at: dict[str, float] = {}  # label → when the process last took what was queued for it
        self._nurseries = tuple(dict.fromkeys((nursery, *apart.values())))
        for each in self._nurseries:
            selector.register(each, selectors.EVENT_READ, each)

    def pid_of(self, label: str) -> int:
        """Returns the process number of a process that is there."""
        pid = self._children[label].pid
        assert pid is not None
        return pid

    # Events

    def look(self, key: selectors.SelectorKey, mask: int) -> None:
        """Feeds what is to be read from the nursery, or from one process."""
        if key.data in self._nurseries:
            self._hear(key.data)
            return
        label, what = key.data
        if what == "words":
            self._read_words(label)
        elif mask & selectors.EVENT_READ:
            self._read_channel(label)

    def _hear(self, nursery: Nursery) -> None:
        try:
            news = nursery.receive()
        except NurseryFailed as failure:
            self._selector.unregister(nursery)
            self._feed(events.Aborted(str(failure)))
            for label in [each for each in self._children if self._nursery_of(each) is nursery]:
                if self._children[label].pid is None:  # it will not be born
                    self._ended(label, None)
            return
        for each in news:
            if isinstance(each, ChildExited):
                self._ended(self._label(each.child), each.code)
            else:
                self._feed(events.OrphansKilled(tuple(map(self._label, each.children)), each.processes))

    def _label(self, process: Child) -> str:
        return next(label for label, child in self._children.items() if child is process)

    def _ended(self, label: str, code: int | None) -> None:
        """A process has ended: what it has said and printed until then comes first."""
        child = self._children[label]
        with contextlib.suppress(ChannelClosed):
            while self._read_messages(label, child):
                pass
        self._read_words(label)
        self._unregister(child)
        for line in child.close():
            self._printed(label, line)
        del self._children[label]
        self._taken_at.pop(label, None)
        if (remains := self._boxes.read(label)) is not None:
            self._feed(events.RecordsRecovered(label, remains))
        self._feed(events.Exited(label, code))

    def _read_channel(self, label: str) -> None:
        child = self._children.get(label)
        if child is None:
            return
        try:
            self._read_messages(label, child)
        except ChannelClosed:
            with contextlib.suppress(KeyError):
                self._selector.unregister(child.channel)
            self._feed(events.Disconnected(label))

    def _read_messages(self, label: str, child: Child) -> bool:
        """Feeds what a process has said; False when there was nothing."""
        any_read = False
        for kind, fields in child.channel.receive():
            any_read = True
            self._feed(events.Received(label, kind, fields))
        return any_read

    def _read_words(self, label: str) -> None:
        child = self._children.get(label)
        if child is None or child.words is None:
            return
        descriptor = child.words
        for line in child.lines():
            self._printed(label, line)
        if child.words is None:
            self._selector.unregister(descriptor)

    def tick(self) -> None:
        """Feeds what nothing but time shows: processes that read nothing, and ends that no nursery reports."""
        now, living = self._clock(), {key.fileobj for key in self._selector.get_map().values()}
        for label, child in list(self._children.items()):
            stuck = now - self._taken_at.get(label, now)
            if stuck > NOT_READING_AFTER or child.channel.overflowed:
                waiting, overflowed = child.channel.waiting, child.channel.overflowed
                self._feed(events.NotReading(label, stuck, waiting, overflowed))
            if self._nursery_of(label) not in living and child.dead:
                self._ended(label, child.bury())

    def _nursery_of(self, label: str) -> Nursery:
        return self._apart.get(label, self._nursery)

    # Commands

    def spawn(self, label: str) -> None:
        """Starts a process, which waits for its configuration."""
        try:
            box = self._boxes.make(label)
            child = self._nursery_of(label).spawn((*self._links.handed(label), *box))
        except (NurseryFailed, OSError) as failure:
            self._feed(events.Aborted(str(failure)))
            return
        self._children[label] = child
        self._taken_at[label] = self._clock()
        self._selector.register(child.channel, selectors.EVENT_READ, (label, "channel"))
        assert child.words is not None
        self._selector.register(child.words, selectors.EVENT_READ, (label, "words"))

    def send(self, label: str, kind: str, fields: dict[str, Any], *, replaces: bool = False) -> None:
        """Queues a message for a process, if it is there."""
        if (child := self._children.get(label)) is not None:
            child.channel.send(kind, fields, replaces=replaces)

    def signal(self, label: str, number: int) -> None:
        """Sends a signal to a process, if it is there."""
        if (child := self._children.get(label)) is not None:
            child.signal(number)

    def flush(self) -> None:
        """Sends what processes take; one that takes nothing is looked at again when it does."""
        now = self._clock()
        for label, child in self._children.items():
            channel = child.channel
            if not channel.waiting:
                self._taken_at[label] = now
                continue
            try:
                if channel.flush():
                    self._taken_at[label] = now
            except ChannelClosed:
                continue  # its end is read, with its cause
            self._watch_for_room(label, child)

    def _watch_for_room(self, label: str, child: Child) -> None:
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if child.channel.waiting else 0)
        key = self._selector.get_map().get(child.channel)
        if key is not None and key.events != wanted:
            self._selector.modify(child.channel, wanted, (label, "channel"))

    # End

    def _unregister(self, child: Child) -> None:
        for thing in (child.channel, child.words):
            if thing is not None:
                with contextlib.suppress(KeyError):
                    self._selector.unregister(thing)

    def bury(self) -> None:
        """Leaves no process behind, however the run has ended."""
        for child in self._children.values():
            self._unregister(child)
            child.signal(signal.SIGKILL)
        for nursery in self._nurseries:
            nursery.close()
        for child in self._children.values():
            child.close()
        self._children.clear()
        self._boxes.close()
