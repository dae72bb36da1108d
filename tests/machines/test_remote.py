"""The supervisor believes a machine only about what is its business, and sends each the files that it lacks."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from joined_agents import HERE

from dataflow.graph import load_text
from dataflow.machines import files
from dataflow.supervision.core import events
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.links import pairs_of
from dataflow.supervision.plan import LINK, Rendezvous, RunPlan, process_plans
from dataflow.supervision.remote import PIECES_ON_THE_WAY, Remote

sys.path.append(str(HERE))
GRAPH = """\
graph: three
namespace: test
operators:
  sensor: {use: "machine_operators:Sensor"}
  left: {use: "machine_operators:Scale", inputs: {x: sensor/count}, machine: robot, params: {weights: robot.bin}}
  right: {use: "machine_operators:Scale", inputs: {x: sensor/count}, machine: arm, params: {weights: arm.bin}}
"""


class Orders:
    """Stands for the processes here: keeps what is sent to the link, by machine."""

    def __init__(self) -> None:
        self.given: list[tuple[str, str, dict[str, Any]]] = []

    def spawn(self, label: str) -> None:
        assert label == LINK

    def send(self, label: str, kind: str, fields: dict[str, Any]) -> None:
        if kind == "to":
            self.given.append((fields["machine"], fields["kind"], fields["fields"]))

    def kinds(self, machine: str) -> Counter[str]:
        return Counter(kind for at, kind, _ in self.given if at == machine)


Says = Callable[..., None]


@pytest.fixture
def met(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Orders, list[events.Event], Says]:
    """What two machines were told, what the core was fed, and how a machine says a word."""
    monkeypatch.chdir(tmp_path)
    for name in ("robot", "arm"):
        Path(f"{name}.bin").write_bytes(name.encode() * (10 * files.PIECE // len(name)))
    plan = RunPlan(load_text(GRAPH), machines=Rendezvous("unixsock-stream/none"))
    processes = process_plans(plan)
    orders, fed = Orders(), list[events.Event]()
    endpoints = dict.fromkeys([*processes, LINK], "none")
    pairs = pairs_of(plan.graph, processes)
    remote = Remote(
        plan, plan.machines, processes, pairs, endpoints, orders, fed.append, lambda *_: None, lambda _: None
    )  # fmt: skip
    for machine in ("robot", "arm"):
        remote.take(events.Received(LINK, "link", {"machine": machine, "up": True}))

    def says(machine: str, kind: str, label: str = "", /, **fields: Any) -> None:
        word = {"machine": machine, "label": label, "kind": kind, "fields": fields}
        remote.take(events.Received(LINK, "from", word))

    return orders, fed, says


def test_each_machine_is_sent_its_files_a_few_pieces_ahead_of_those_that_it_took(
    met: tuple[Orders, list[events.Event], Says],
) -> None:
    orders, _, says = met

    for machine in ("robot", "arm"):
        says(machine, "lacks", files=[f"{machine}.bin"])

    for machine in ("robot", "arm"):
        assert orders.kinds(machine)["file"] == PIECES_ON_THE_WAY
        for _ in range(10):
            says(machine, "took")
        sent = [fields for at, kind, fields in orders.given if at == machine and kind == "file"]
        assert b"".join(each["data"] for each in sent) == Path(f"{machine}.bin").read_bytes()
        assert orders.kinds(machine)["begin"] == 1


def test_a_file_that_was_not_offered_is_sent_to_no_machine(met: tuple[Orders, list[events.Event], Says]) -> None:
    orders, _, says = met
    with pytest.raises(RunFailed, match=r"machine 'robot' asks for files that it was not offered: arm\.bin"):
        says("robot", "lacks", files=["arm.bin"])
    assert orders.kinds("robot")["file"] == 0


def test_machine_reports_only_its_own_processes(met: tuple[Orders, list[events.Event], Says]) -> None:
    _, fed, says = met

    says("robot", "died", "right", code=1)
    says("robot", "died", "sensor", code=1)
    says("robot", "died", "", code=1)
    says("robot", "left", labels=["right"], processes=["cat"])
    assert not fed

    says("robot", "died", "left", code=1)
    assert fed == [events.Exited("left", 1)]
