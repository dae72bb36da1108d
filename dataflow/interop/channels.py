"""Joins the channels of a bag into topics: of several publishers, of split files, and of two types under one name."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from dataflow.interop.bag import Topic

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Joined(Generic[Key]):
    """Topics by name, in alphabetical order; the topic of each channel; and what is unusual, for people."""

    topics: Mapping[str, Topic]
    owner: Mapping[Key, str]
    notes: tuple[str, ...]


def join(channels: Iterable[tuple[Key, Topic]]) -> Joined[Key]:
    """Joins channels of one name where their messages are laid out equally.

    Of channels that are not, the type with most messages keeps the name; each other one is a topic `NAME (TYPE)`.
    """
    named: dict[str, list[tuple[list[Key], Topic]]] = {}
    for key, topic in channels:
        kinds = named.setdefault(topic.name, [])
        for place, (keys, known) in enumerate(kinds):
            if _same_layout(known, topic):
                kinds[place] = ([*keys, key], _sum(known, topic))
                break
        else:
            kinds.append(([key], topic))
    topics: dict[str, Topic] = {}
    owner: dict[Key, str] = {}
    notes = []
    for name, kinds in named.items():
        kinds.sort(key=lambda kind: -kind[1].count)
        for place, (keys, topic) in enumerate(kinds):
            called = name
            if place:
                called = f"{name} ({topic.schema.name})"
                while called in topics or called in named:
                    called += "'"
                most = kinds[0][1]
                what = "definitions" if topic.schema.name == most.schema.name else "types"
                notes.append(
                    f"topic {name} holds messages of two {what}: {topic.count:,} of {topic.schema.name} are the topic "
                    f"{called!r} here, beside {most.count:,} of {most.schema.name}"
                )
            topics[called] = replace(topic, name=called)
            owner |= dict.fromkeys(keys, called)
    return Joined(dict(sorted(topics.items())), owner, tuple(notes))


def _same_layout(a: Topic, b: Topic) -> bool:
    if a.encoding != b.encoding:
        return False
    if a.schema == b.schema or (a.schema.data == b.schema.data and a.schema.data):
        return True
    if a.encoding not in ("cdr", "ros1"):
        return False
    from dataflow.interop.typestores import same_layout  # rosbags takes long to import

    return same_layout(a.encoding, a.schema, b.schema)


def _sum(a: Topic, b: Topic) -> Topic:
    return replace(
        a,
        schema=a.schema if a.schema.data else b.schema,
        count=a.count + b.count,
        first=min((t for t in (a.first, b.first) if t is not None), default=None),
        last=max((t for t in (a.last, b.last) if t is not None), default=None),
        bytes=None if a.bytes is None or b.bytes is None else a.bytes + b.bytes,
        latched=a.latched or b.latched,
    )
