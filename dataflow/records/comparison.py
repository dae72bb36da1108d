"""The outcome of re-executing one operator by its firing records: what was repeated, and the first difference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Verdict = Literal["identical", "culprit", "downstream", "unverifiable"]


@dataclass(frozen=True, slots=True)
class Difference:
    """The first record of an operator that differs. `expected` and `got` are digests, or say what else differs.

    `call`: the number of the call among the operator's, of what lies between calls (a state) of the one before; None
    before all calls, and where the records were not counted. `index`: of the record in its incarnation.
    """

    index: int
    kind: str
    stamp: int
    port: str
    expected: str
    got: str
    incarnation: int = 0
    call: int | None = None


@dataclass(slots=True)
class Verification:
    """Counts of what re-executing one operator repeated, and where it differs first.

    `verified` firings were repeated and compared; `unverifiable` ones could not be, because a message they were given
    is unavailable; `lost_records` are missing between others, so the firings that follow them in their incarnation
    cannot be repeated either. `unknown` firings follow the beginning of a part of a recording in which the operator's
    state there is not known. `beyond` of the unverifiable ones wait for a message after the last one of its stream.
    `unaccounted` messages were made by no record. `unfinished`: the records end before the run did, so records are
    lost. `cut`: the recording itself ends before the run did, and before this operator; `after_cut` are then the
    messages without a record. `not_stored` messages were made again, but are not in the recording.
    `tainted` is the index of the first firing that was given anything other than recorded; `own_fault`: the
    first difference came before that; `states` of the differences are in snapshots, not in messages; `differences`
    is the digest of all that was made in place of what was recorded.
    `code_changed`: its modules whose code is no longer, in any incarnation, what it was; `code_known`: the recording
    has digests of that code. `packages_changed`: packages
    of its environment (`env:`) of which it ran other versions, such as "numpy 1.26.4 -> 2.4.6".
    `wrote` names the first message that the operator has written into, which others may be given too.
    `effects`: by name of a call how often its recorded answer was `given`, `missed`, and, where calls were made again,
    `again` and of these with the `same` answer.
    `began` is the state from which it was repeated: "start", "snapshot" (its recorded state) or "stateless".
    """

    operator: str
    firings: int = 0
    verified: int = 0
    outputs: int = 0
    differing: int = 0
    states: int = 0
    differences: str = ""
    unverifiable: int = 0
    beyond: int = 0
    lost_records: int = 0
    unknown: int = 0
    unaccounted: int = 0
    unfinished: bool = False
    cut: bool = False
    after_cut: int = 0
    not_stored: int = 0
    began: str = "start"
    own_fault: bool = False
    tainted: int | None = None
    first: Difference | None = None
    missing: str = ""
    wrote: str = ""
    files_changed: list[str] = field(default_factory=list)
    code_changed: list[str] = field(default_factory=list)
    code_known: bool = False
    packages_changed: list[str] = field(default_factory=list)
    effects: dict[str, dict[str, int]] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        if self.wrote:
            return "culprit"
        if self.first is not None:
            return "culprit" if self.own_fault else "downstream"
        return "identical" if self.whole else "unverifiable"

    @property
    def whole(self) -> bool:
        """True when everything that was recorded before the cut, if there is one, was repeated, and there was any."""
        if self.lost_records or self.unknown or self.unaccounted or self.unfinished:
            return False
        if self.cut:
            return self.unverifiable == self.beyond and (self.verified > 0 or not (self.beyond or self.after_cut))
        return not self.unverifiable

    def to_wire(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> Verification:
        first = values["first"]
        return Verification(**{**values, "first": None if first is None else Difference(**first)})
