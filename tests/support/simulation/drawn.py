"""Graphs by seed: a few operators of any kind, wired at random, with feedback wherever an input looks into the past;
some of them in a nested graph."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator, Mapping

KINDS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "Relay": ("x", ("y",)),
    "Mean": ("x", ("y",)),
    "Merge": ("all*", ("y",)),
    "Sum": ("x", ()),
    "Mix": ("a b constant! feedback< recent", ("y",)),
    "Loop": ("x last@ beside", ("y",)),
    "LoopedBatch": ("x last@ rest", ("y",)),
    "Delayed": ("x old<", ("y",)),
    "Lagging": ("x", ("y",)),
    "Leading": ("x", ("y", "half")),
    "Near": ("a b c", ("y",)),
    "Both": ("a b", ("y",)),
    "Either": ("a b", ("y",)),
    "Beat": ("x rest", ("y",)),
    "Placed": ("x constant!", ("y",)),
    "Arm": ("x", ("y",)),
    "Hoard": ("x", ("y",)),
}
"""Operators with their inputs and outputs. An input takes a stream from above; `!` a static one, `*` several, `<` any,
also from below, and `@` mostly the operator's own."""
WORK = ("Relay", "Mean", "Merge", "Sum", "Mix", "Loop", "LoopedBatch", "Near")
"""Those whose calls take time."""
OUTSIDE = "Arm"
MOST = 5


def drawn(r: random.Random, *, live: bool) -> tuple[str, ...]:
    """Returns the operators of a graph, a line of YAML each; the loader may refuse their feedback."""
    lines = ["left: {SOURCE}"]
    streams, statics = ["left/fast", "left/slow"], ["left/constant"]
    if r.random() < 0.6:
        lines.append(r.choice(("right: {SOURCE}", "right: {OTHER}", "right: {SHORT}", "right: {PAIR}")))
        streams += ["right/fast", "right/slow"]
    if r.random() < 0.3:
        lines.append("mount: {use: simulation.operators:Pose, inputs: {x: STREAM}LIVE}".replace("STREAM", streams[-1]))
        statics.append("mount/mount")
    chosen = [(f"{kind.lower()}{k}", kind) for k, kind in enumerate(r.choices(sorted(KINDS), k=r.randint(1, MOST)))]
    below = [f"{name}/{port}" for name, kind in chosen for port in KINDS[kind][1]]
    for name, kind in chosen:
        ports, outputs = KINDS[kind]
        taken = {port.strip("!*<@"): _stream(r, port, name, streams, statics, below) for port in ports.split()}
        inputs = ", ".join(f"{port}: {stream}" for port, stream in taken.items())
        work = ", params: {work: WORK}" if kind in WORK else ""
        where = f", process: {r.choice('pq')}" if r.random() < 0.2 else ""
        policies = "LIVE" if live and r.random() < 0.7 else ""
        lines.append(f"{name}: {{use: simulation.operators:{kind}, inputs: {{{inputs}}}{work}{where}{policies}}}")
        streams += [f"{name}/{port}" for port in outputs]
    return tuple(lines)


def _stream(r: random.Random, port: str, name: str, streams: list[str], statics: list[str], below: list[str]) -> str:
    match port[-1]:
        case "!":
            return r.choice(statics)
        case "*":
            return f"[{', '.join(r.sample(streams, k=min(len(streams), r.randint(1, 3))))}]"
        case "@" if r.random() < 0.8:
            return f"{name}/y"
        case "@" | "<":
            return r.choice([*streams, *below])
    return r.choice(streams)


NESTED = "part.yaml"
_STREAM = re.compile(r"\b(\w+)/(\w+)\b")


def nested(lines: tuple[str, ...], r: random.Random) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Moves some operators into a nested graph, which the outer one may use twice. Returns the lines of both."""
    names = [line.partition(":")[0] for line in lines]
    movable = [k for k, line in enumerate(lines) if any(f":{kind}," in line for kind in KINDS)]
    moved = set(r.sample(movable, k=r.randint(1, len(movable))))
    inside = {names[k] for k in moved}
    inputs: dict[str, str] = {}

    def inner(found: re.Match[str]) -> str:
        return found[0] if found[1] in inside else inputs.setdefault(found[0], f"i{len(inputs)}")

    def outer(found: re.Match[str]) -> str:
        return f"part/{found[1]}_{found[2]}" if found[1] in inside else found[0]

    operators = [f"  {_STREAM.sub(inner, lines[k])}" for k in sorted(moved)]
    ports = [(names[k], port) for k in moved for kind in KINDS if f":{kind}," in lines[k] for port in KINDS[kind][1]]
    outputs = ", ".join(f"{name}_{port}: {name}/{port}" for name, port in ports)
    text = [
        "graph: part",
        f"inputs: [{', '.join(inputs.values())}]",
        f"outputs: {{{outputs}}}",
        "operators:",
        *operators,
    ]
    wired = ", ".join(f"{name}: {_STREAM.sub(outer, stream)}" for stream, name in inputs.items())
    rest = [_STREAM.sub(outer, line) for k, line in enumerate(lines) if k not in moved]
    rest += [f"{name}: {{use: {NESTED}, inputs: {{{wired}}}}}" for name in ("part", "again")[: r.choice((1, 1, 2))]]
    return tuple(rest), tuple(text)


def repeats(lines: tuple[str, ...]) -> bool:
    """Tells whether the graph has an operator that is executed again when its recording is verified."""
    return any(f":{kind}," in line for kind in KINDS if kind != OUTSIDE for line in lines)


def without(lines: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yields the graph with one operator less, where no other takes from it."""
    for k, line in enumerate(lines):
        name = line.partition(":")[0]
        rest = lines[:k] + lines[k + 1 :]
        if repeats(rest) and not any(f"{name}/" in other for other in rest):
            yield rest
