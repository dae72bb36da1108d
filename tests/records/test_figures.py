"""Figures that operators sum up are read with their units, and found again in a recording."""

from __future__ import annotations

from pathlib import Path

from dataflow.recording import Recording, RecordingWriter
from dataflow.records.figures import figure, figures, recorded_summaries
from dataflow.records.firing import FiringRecord, encode_batch


def test_figures_carry_the_unit_of_their_name() -> None:
    assert figure("ate_rmse_m", 0.0212999) == ("ate rmse", "0.0213", "m")
    assert figure("rpe_1s_rmse_deg", 0.5) == ("rpe 1s rmse", "0.5", "°")
    assert figure("unmatched_poses", 12345) == ("unmatched poses", "12,345", "")
    assert figure("alignment_m", "se3") == ("alignment m", "se3", "")


def test_figures_of_one_name_in_several_units_have_one_line() -> None:
    score = {"matched": 90, "rpe_1s_rmse_m": 0.0213, "rpe_1s_rmse_deg": 0.5, "rpe_1m_rmse_m": 0.02, "alignment": "se3"}

    assert figures(score) == {
        "matched": "90",
        "rpe 1s rmse": "0.0213 m, 0.5 °",
        "rpe 1m rmse": "0.02 m",
        "alignment": "se3",
    }
    assert list(figures(score)) == ["matched", "rpe 1s rmse", "rpe 1m rmse", "alignment"]


def test_recorded_summaries_are_those_of_the_last_finish(tmp_path: Path) -> None:
    calls = [FiringRecord("score", 0, 0, "fire", 5)]
    ends = [FiringRecord("score", i, 1, "finish", 9, detail={"summary": {"matched": 3 + i}}) for i in range(2)]
    with RecordingWriter(tmp_path / "a.mcap", metadata={}) as writer:
        for records in (calls, *([record] for record in ends)):
            writer.write_firings("score", records[-1].stamp, encode_batch(records))
    with Recording(tmp_path / "a.mcap") as recording:
        assert recorded_summaries(recording, ["score", "absent"]) == {"score": {"matched": 4}}
