"""Policies of one operator: how it synchronises (`sync:`) and behaves in a live run (`live:`)."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.graph.drafts import OperatorDraft
from dataflow.graph.model import Live, QueuePolicy, Restart, StalePolicy
from dataflow.graph.problems import did_you_mean
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.tree import Leaf, Table, Tree
from dataflow.operator import InputPort, OperatorSpec, is_source

QUEUE_SIZE = 16
"""Undecided messages on each trigger stream, by default."""
JOIN_WAIT = 100_000_000
"""Time (ns) that a join or merge fed by devices waits for each input, by default."""

_QUEUES: Mapping[str, QueuePolicy] = {"newest": "newest", "oldest": "oldest", "block": "block"}
_STALE: Mapping[str, StalePolicy] = {"use": "use", "drop": "drop"}


def sync_tolerance(draft: OperatorDraft, fields: Fields) -> int:
    """Nanoseconds of the operator's join: the graph's `sync:` or the class's own."""
    spec = draft.cls.spec
    tree = draft.sync.get("tolerance") if isinstance(draft.sync, Table) else None
    if tree is None:
        return spec.tolerance
    if spec.merge or len(spec.triggers) < 2:
        how = "merges its inputs" if spec.merge else "has no two inputs to join"
        fields.problems.add(tree.place, f"{draft.name}: 'tolerance' means nothing here: {spec.name} {how}")
        return spec.tolerance
    given = fields.duration(tree, f"{draft.name}: tolerance")
    return spec.tolerance if given is None else given


def sync_every(draft: OperatorDraft, fields: Fields) -> int | None:
    """Period (ns) of the operator's ticks: the graph's `sync:` or the class's own."""
    spec = draft.cls.spec
    sync = fields.table(draft.sync, "sync", ("tolerance", "every"))
    tree = sync.get("every") if sync else None
    if tree is None:
        return spec.every
    if spec.every is None:
        hint = f"its class would have to say every=... ({spec.name} fires on messages only)"
        fields.problems.add(tree.place, f"{draft.name}: 'every' cannot be set: {spec.name} does not tick", hint)
        return None
    given = fields.duration(tree, f"{draft.name}: every")
    if given == 0:
        fields.problems.add(tree.place, f"{draft.name}: every must be longer than 0")
    return given or spec.every


def live_policy(draft: OperatorDraft, devices: bool, fields: Fields) -> Live:
    """The operator's `live:`. `devices`: something upstream is a source that cannot wait."""
    keys = ("queue", "size", "wait", "deadline", "restart", "memory", "on_stale", "clock")
    table = fields.table(draft.live, "live", keys)
    get = table.get if table else lambda _: None
    spec = draft.cls.spec
    joined = len(spec.triggers) > 1
    queue = fields.choice(get("queue"), "queue", _QUEUES)
    size = fields.integer(get("size"), "size", 1, 1_000_000)
    restart = fields.table(get("restart"), "restart", ("max", "backoff"))
    attempts = fields.integer(restart.get("max") if restart else None, "max", 0, 1_000_000)
    backoff = fields.duration(restart.get("backoff") if restart else None, "backoff")
    return Live(
        queue=queue or ("newest" if devices else "block"),
        size=size or (1 if queue == "newest" and not joined else QUEUE_SIZE),
        wait=_waits(get("wait"), draft, devices, fields),
        deadline=fields.duration(get("deadline"), "deadline"),
        restart=Restart(attempts or 0, Restart().backoff if backoff is None else backoff),
        memory=fields.size(get("memory"), "memory"),
        on_stale=fields.choice(get("on_stale"), "on_stale", _STALE) or "use",
        corrected=_corrected(get("clock"), draft, fields),
    )


def _corrected(tree: Tree | None, draft: OperatorDraft, fields: Fields) -> bool:
    """Returns whether stamps are corrected by the measured offset of the machine's clock."""
    chosen = fields.choice(tree, "clock", {"own": "own", "corrected": "corrected"})
    if tree is not None and chosen == "corrected" and not (draft.machine and is_source(draft.cls)):
        why = f"{draft.name}: 'clock: corrected' is for a source on another machine (machine:)"
        fields.problems.add(tree.place, why)
    return chosen == "corrected"


def _waits(tree: Tree | None, draft: OperatorDraft, devices: bool, fields: Fields) -> dict[str, int | None]:
    spec = draft.cls.spec
    waits = {name: default_wait(spec, port, devices) for name, port in spec.inputs.items()}
    if isinstance(tree, Table):
        for name, entry in tree.entries.items():
            if name not in spec.inputs:
                hint = did_you_mean(name, spec.inputs, f"inputs of {spec.name}")
                fields.problems.add(entry.key.place, f"{draft.name}: {spec.name} has no input {name!r}", hint)
            else:
                waits[name] = _wait(entry.value, waits[name], fields)
    elif tree is not None:
        waits = {name: _wait(tree, default, fields) for name, default in waits.items()}
    return waits


def _wait(tree: Tree, default: int | None, fields: Fields) -> int | None:
    if isinstance(tree, Leaf) and tree.value == "forever":
        return None
    given = fields.duration(tree, "wait")
    return default if given is None else given


def default_wait(spec: OperatorSpec, port: InputPort, devices: bool) -> int | None:
    """Returns how long (ns) a live decision waits for an input; None, for ever, where every source upstream can wait.

    Fed by a device: 0 for Sampled and Batch and for a single trigger, `JOIN_WAIT` for joined and merged triggers, and
    for a trigger beside a timer the timer's period, if that is less: else a tick would shut out messages of its stamp.
    """
    if not devices:
        return None
    if spec.every is not None and port.kind == "in":
        return min(JOIN_WAIT, spec.every)
    joined = port.kind == "in" and (len(spec.triggers) > 1 or port.many)
    return JOIN_WAIT if joined else 0
