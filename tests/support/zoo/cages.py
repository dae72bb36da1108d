"""Which operators of the zoo run in one graph, and the verdict that is right for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dataflow.graph import Graph, load_text
from zoo.operators import STEPS

REPEATS = (
    *("Hard", "KeptGenerator", "Pool", "Loop", "Views", "Draws", "States", "LazyLibrary", "LazyModule", "Command"),
    *("Fork", "Files", "Large", "FailsToClose", "OddTimer", "Decimals", "Sets", "Finalizers", "Bits"),
    "Workers",
)
DOES_NOT = (
    *("Race", "Clock", "LateClock", "Entropy", "OwnGenerator", "Process", "Background"),
    *("Sometimes", "Stamps", "ZeroSigns", "Sums", "ClockedState", "LastWord"),
)
AT_THE_END = ("Sums", "LastWord")
"""Those of `DOES_NOT` whose calls repeat: a run that was killed has nothing of them that does not."""


@dataclass(frozen=True, slots=True)
class Cage:
    """The operators of one graph, by name: class, and what it takes. `verdicts` are those that are right where each has
    a process, `together` those that are right where they share one."""

    operators: Mapping[str, tuple[str, str]]
    verdicts: Mapping[str, str]
    together: Mapping[str, str]

    def graph(self, steps: int = STEPS) -> Graph:
        lines = [f"  {n}: {{use: 'zoo.operators:{use}', inputs: {{x: {x}}}}}" for n, (use, x) in self.operators.items()]
        source = f"  src: {{use: 'zoo.operators:Steps', params: {{steps: {steps}}}}}"
        return load_text("\n".join(["graph: zoo", "record: {snapshots: 500ms}", "operators:", source, *lines]))


def _cage(operators: Mapping[str, tuple[str, str]], culprits: str = "", together: str = "") -> Cage:
    def verdicts(names: str) -> dict[str, str]:
        return {name: "culprit" if name in names.split() else "identical" for name in operators}

    return Cage(operators, verdicts(culprits), verdicts(together or culprits))


CAGES: Mapping[str, Cage] = {
    "each for itself": _cage({use: (use, "src/out") for use in (*REPEATS, *DOES_NOT)}, " ".join(DOES_NOT)),
    "a module": _cage({"one": ("Count", "src/out"), "two": ("Count", "src/out")}),
    "a setting": _cage({"strict": ("Strict", "src/out"), "divide": ("Divide", "src/out")}),
    "an input": _cage({"writer": ("Overwrite", "src/out"), "reader": ("Hard", "src/out")}, "writer"),
    "an output": _cage({"keeper": ("KeepsEmitted", "src/out"), "before": ("Before", "keeper/out")}, "", "keeper"),
}
