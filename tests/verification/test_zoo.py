"""The verdict on each operator of the zoo is the right one; `benchmarks/verdicts.py` runs it in all ways."""

from __future__ import annotations

from pathlib import Path

import pytest
from zoo.cages import CAGES

from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.run import run
from dataflow.verification.verify import verify


@pytest.mark.long
def test_hard_operators_in_one_process_get_the_right_verdicts(tmp_path: Path) -> None:
    cage = CAGES["each for itself"]
    with pytest.raises(RunFailed, match="it does not close"):
        run(cage.graph(), placement="one_process", record=tmp_path / "run.mcap")

    report = verify(tmp_path / "run.mcap")

    assert {v.operator: report.verdict(v) for v in report.operators} == cage.together
    assert report.repeated == {name: False for name, verdict in cage.together.items() if verdict == "culprit"}
    assert not report.shared
