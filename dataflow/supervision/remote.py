"""The other machines of a run, as its supervisor has them: their agents do what is done here by `Children`.

Orders go, and events come, through the link's process. Before the run begins each machine is shown what it needs; code
that differs ends the run, files that it lacks are sent.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dataflow.execution.threads import THREADS, environment
from dataflow.graph.model import Node
from dataflow.graph.sections import Network
from dataflow.machines import files
from dataflow.machines.gate import Routes
from dataflow.names import firings_key
from dataflow.recording.streams.facts import FACTS, record_elsewhere
from dataflow.records.black_box import OperatorProgress, RecoveredRecords
from dataflow.supervision.children import Children
from dataflow.supervision.core import events
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.links import Pairs, gate_of
from dataflow.supervision.plan import LINK, ProcessPlan, Rendezvous, RunPlan

PIECES_ON_THE_WAY = 4
"""Pieces of files that were sent to a machine before it took the first of them."""

OF_THE_AGENT = ("differs", "lacks", "took", "ready", "left", "failed")
"""The words that are about a machine as a whole."""


class Remote:
    """The machines that the processes of a plan name. `feed` takes events, `printed` the lines of processes, `note`
    what the user is shown."""

    def __init__(
        self,
        plan: RunPlan,
        rendezvous: Rendezvous,
        processes: Mapping[str, ProcessPlan],
        pairs: Pairs,
        endpoints: Mapping[str, str],
        here: Children,
        feed: Callable[[events.Event], None],
        printed: Callable[[str, str], None],
        note: Callable[[str], None],
    ) -> None:
        """`endpoints`: by label, where the processes here and the link listen."""
        self._live = plan.live
        self._plan, self._rendezvous, self._processes, self._pairs = plan, rendezvous, processes, pairs
        self._here, self._feed, self._printed, self._note = here, feed, printed, note
        self.machine_of = {
            label: process.machine for label, process in processes.items() if process.machine is not None
        }
        self._machines = sorted(set(self.machine_of.values()))
        self._missing: dict[str, str] = dict.fromkeys(self._machines, "did not join")
        """By machine, why the run cannot begin yet."""
        self._files: dict[str, files.Digests] = {}
        self._pieces: dict[str, Iterator[dict[str, Any]]] = {}
        self.taken = 0
        """Pieces of files that machines took."""
        self.facts: dict[str, dict[str, str]] = {}
        """Metadata of a recording: the facts of each machine (`machine_facts`), as its agent reports them."""
        self._noted: set[str] = set()
        self.ending = False
        """The machines are being let go."""
        self.ended = False
        """The link's process has ended."""
        here.spawn(LINK)
        here.send(LINK, "link", self._link_config(endpoints))

    def _link_config(self, endpoints: Mapping[str, str]) -> dict[str, Any]:
        graph = self._plan.graph
        return {
            **link_of(self._live, self._processes, self._pairs, gate_of(None)),
            "endpoint": self._rendezvous.endpoint,
            "keys": None if self._rendezvous.keys is None else str(self._rendezvous.keys.absolute()),
            "listen": endpoints[LINK],
            "connect": [at for label, at in endpoints.items() if label != LINK and label not in self.machine_of],
            "run": secrets.token_hex(8),
            "machines": self._machines,
            "namespace": graph.namespace,
            "routes": self._routes().to_json(),
            "graph": graph.to_json(),
            "live": self._live,
        }

    def _routes(self, of: str = "") -> Routes:
        """Returns what passes between machines, as one of them sends it; the supervisor's is called "", and is the only
        one that others send to."""
        graph = self._plan.graph
        takers: dict[str, list[str]] = {}
        makers: dict[str, list[str]] = {}
        for (maker, taker), keys in self._pairs.items():
            for machine in ("", *self._machines):
                gate, found = gate_of(machine or None), takers if maker == gate_of(machine or None) else makers
                if gate in (maker, taker):
                    for key in keys:
                        found.setdefault(key, []).append(machine)
        raw = frozenset(firings_key(graph.namespace, node) for node in graph.nodes)
        takers = {key: sorted(set(machines)) for key, machines in takers.items()}
        if of:
            takers = {key: [""] if set(machines) - {of} else [] for key, machines in takers.items()}
            makers = {key: [""] for key in takers}
        return Routes(sorted(takers), makers, takers, graph.static & takers.keys(), raw & takers.keys())

    # Before the run

    @property
    def waits_for(self) -> tuple[str, ...]:
        """Returns the machines that are not ready."""
        return tuple(self._missing)

    def not_ready(self, seconds: float) -> RunFailed:
        """Returns the failure of a run for which machines were not ready in time."""
        how = "; ".join(f"machine {name!r} {why}" for name, why in self._missing.items())
        return RunFailed(f"not ready within {seconds:g} s: {how}. On each: {self.advice()}")

    def advice(self) -> str:
        """Returns the command that joins a machine."""
        keys = "" if self._rendezvous.keys is None else " --keys FOLDER"
        return f"dataflow join NAME --connect {self._rendezvous.endpoint}{keys}"

    def _prepare(self, machine: str) -> None:
        """Shows a machine, once, what it needs."""
        graph = self._plan.graph
        labels = [label for label, at in self.machine_of.items() if at == machine]
        nodes = [graph.nodes[name] for label in labels for name in self._processes[label].nodes]
        params = [node.params for node in nodes]
        gate = gate_of(machine)
        wanted = environment(graph.threads)
        try:
            self._files[machine] = files.files_of(params, Path.cwd())
        except files.FilesError as error:
            raise RunFailed(str(error)) from error
        self._missing[machine] = "is being given its files"
        self._say(
            machine,
            "prepare",
            code=files.code_of(
                (node.use for node in nodes), files.texts_of(params + [_defaults(node) for node in nodes])
            ),
            python=files.python(),
            files=self._files[machine],
            uses=[node.use for node in nodes],
            graph=graph.to_json() | {"network": asdict(Network())},
            processes=[asdict(self._processes[label]) for label in labels],
            pairs=[[*pair, list(keys)] for pair, keys in self._pairs.items() if {*labels, gate} & set(pair)],
            gate=link_of(self._live, self._processes, self._pairs, gate),
            routes=self._routes(machine).to_json(),
            threads={name: wanted[name] for name in THREADS},
            live=self._live,
        )

    def _send_files(self, machine: str, lacking: list[str]) -> None:
        """Begins to send what a machine lacks: a few pieces, then one more for each that it took."""
        digests = self._files.get(machine, {})
        if unknown := [text for text in lacking if Path(text).is_absolute() or text not in digests]:
            raise RunFailed(f"machine {machine!r} asks for files that it was not offered: {', '.join(unknown)}")
        self._pieces[machine] = (
            {"path": text, "at": at, "data": data, "last": last, "digest": digests[text]}
            for text in lacking
            for at, data, last in files.pieces(Path.cwd() / text)
        )
        for _ in range(PIECES_ON_THE_WAY):
            self._send_piece(machine)

    def _send_piece(self, machine: str) -> None:
        if (pieces := self._pieces.get(machine)) is None:
            return
        try:
            piece = next(pieces, None)
        except OSError as error:
            raise RunFailed(f"a file for machine {machine!r} cannot be read: {error}") from error
        if piece is not None:
            self._say(machine, "file", **piece)
        else:
            del self._pieces[machine]
            self._say(machine, "begin")

    # Orders

    def _say(self, machine: str, word: str, label: str = "", /, **fields: Any) -> None:
        self._here.send(LINK, "to", {"machine": machine, "label": label, "kind": word, "fields": fields})

    def spawn(self, label: str) -> None:
        """Starts a process on its machine."""
        self._say(self.machine_of[label], "spawn", label)

    def send(self, label: str, kind: str, fields: dict[str, Any], *, replaces: bool = False) -> None:
        """Sends a message to a process on its machine."""
        self._say(self.machine_of[label], "send", label, kind=kind, fields=fields, replaces=replaces)

    def signal(self, label: str, number: int) -> None:
        """Sends a signal to a process on its machine."""
        self._say(self.machine_of[label], "signal", label, number=number)

    def close(self) -> None:
        """Lets the machines go; the link ends when they know."""
        self.ending = True
        for machine in self._machines:
            self._say(machine, "over")
        self._here.send(LINK, "leave", {})

    # News

    def take(self, event: events.Event) -> None:
        """Takes an event of the link's process. Raises `RunFailed` when the run cannot do without it any more."""
        match event:
            case events.Received(_, "failed", fields):
                raise RunFailed(f"the link to other machines failed: {fields['summary']}", fields["traceback"])
            case events.Received(_, kind, fields):
                self._heard(kind, fields)
            case events.NotReading(_, seconds, waiting, True) if not self.ending:
                raise RunFailed(
                    f"the link to other machines has read nothing for {seconds:.1f} s; {waiting} words wait"
                )
            case events.Exited():
                self.ended = True
                if not self.ending:
                    raise RunFailed("the link to other machines died")

    def _heard(self, kind: str, fields: Mapping[str, Any]) -> None:
        machine = fields.get("machine", "")
        match kind:
            case "from":
                self._from(machine, fields["label"], fields["kind"], fields["fields"])
            case "link":
                self._link(machine, up=fields["up"])
            case "clock":
                self._feed(events.ClockMeasured(machine, fields["offset"], fields["delay"]))
            case "busy":
                self._note_once(f"machine {machine!r} still has another run, and is waited for")
            case "another":
                self._note_once(f"another machine joins as {machine!r}; it gets nothing while the first is there")
            case "anew":
                raise RunFailed(
                    f"machine {machine!r} has left the run: its agent was started anew, or has not heard this machine "
                    "for longer than its --timeout; its operators are gone"
                )

    def _note_once(self, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self._note(text)

    def _link(self, machine: str, *, up: bool) -> None:
        if self._missing.get(machine) == "did not join":
            self._prepare(machine)
        elif machine not in self._missing:
            labels = tuple(label for label, at in self.machine_of.items() if at == machine)
            self._feed(events.LinkChanged(machine, labels, up))

    def _from(self, machine: str, label: str, kind: str, fields: dict[str, Any]) -> None:
        """Takes a word of a machine, which may be about its own processes alone."""
        about = [label] if label else fields.get("labels", [])
        if any(self.machine_of.get(each) != machine for each in about) or (not label) != (kind in OF_THE_AGENT):
            self._note_once(f"machine {machine!r} reports about processes that it does not have; it is not believed")
            return
        match kind:
            case "said":
                self._feed(events.Received(label, fields["kind"], fields["fields"]))
            case "printed":
                self._printed(label, fields["line"])
            case "hung up":
                self._feed(events.Disconnected(label))
            case "not reading":
                self._feed(events.NotReading(label, **fields))
            case "remained":
                reached = {name: OperatorProgress(*values) for name, values in fields["reached"].items()}
                self._feed(events.RecordsRecovered(label, RecoveredRecords(fields["batches"], reached)))
            case "died":
                self._feed(events.Exited(label, fields["code"]))
            case "left":
                self._feed(events.OrphansKilled(tuple(fields["labels"]), tuple(fields["processes"])))
            case "differs":
                what = "; ".join(fields["what"][:20]) + ("; ..." if len(fields["what"]) > 20 else "")
                raise RunFailed(f"machine {machine!r} cannot take part: {what}")
            case "lacks":
                self._send_files(machine, fields["files"])
            case "took":
                self.taken += 1
                self._send_piece(machine)
            case "ready":
                for group in FACTS & fields["facts"].keys():
                    values = {str(name): str(value) for name, value in fields["facts"][group].items()}
                    self.facts[record_elsewhere(group, machine)] = values
                del self._missing[machine]
            case "failed":
                raise RunFailed(f"machine {machine!r}: {fields['why']}")


def _defaults(node: Node) -> dict[str, Any]:
    return {name: declared.default for name, declared in node.spec.parameters.model_fields.items()}


def link_of(live: bool, processes: Mapping[str, ProcessPlan], pairs: Pairs, gate: str) -> dict[str, Any]:
    """Returns a gate's part of its configuration: its label and the links that it has."""
    outgoing = [
        [live and processes[taker].sink is None, list(keys)] for (maker, taker), keys in pairs.items() if maker == gate
    ]
    incoming = [list(keys) for (_, taker), keys in pairs.items() if taker == gate]
    return {"label": gate, "links_out": outgoing, "links_in": incoming}
