"""A chain leads to the reading that decided, names the largest effect first, and claims nothing where none shows."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import rangers
from typer.testing import CliRunner

import dataflow
from dataflow.blame.chain import Blame
from dataflow.blame.field import Field
from dataflow.blame.line import Call
from dataflow.blame.links import Chain, Link
from dataflow.blame.nudge import made_finite, nudged
from dataflow.cli.commands.blame import _in_runs
from dataflow.cli.main import app
from dataflow.debugging.debugger import Debugger
from dataflow.graph import load_graph, load_text
from dataflow.messages import FeatureVector, RangeReading
from dataflow.recording import Recording

GRAPH = """graph: rig
operators:
  finder: {use: "rangers:Finder", params: {approaches: %s}}
  smooth: {use: "rangers:Smooth", inputs: {range: finder/range}}
  guard: {use: "rangers:Guard", inputs: {value: smooth/out}}
  brake: {use: "rangers:Brake", inputs: {range: finder/range}}
  describe: {use: "rangers:Describe", inputs: {range: finder/range}}
"""


@pytest.fixture(scope="module")
def spiky(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("spiky") / "run.mcap"
    dataflow.run(load_text(GRAPH % "false"), record=path)
    return path


@pytest.fixture(scope="module")
def approaching(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("approaching") / "run.mcap"
    dataflow.run(load_text(GRAPH % "true"), record=path)
    return path


def found(path: Path, field: str) -> Chain:
    with Recording(path) as recording:
        return Blame(recording, Field.parse(field)).find()


def sensed(chain: Chain) -> list[int]:
    return [number for link in chain.sensed for _, _, number in link.messages]


@pytest.mark.parametrize("step", [40, 59])  # behind it, a block of earlier calls ends among those that tripped it
def test_latch_behind_low_pass_leads_to_the_reading_that_tripped_it(step: int, spiky: Path) -> None:
    chain = found(spiky, f"guard/stop.on@{step / 10}")

    assert sensed(chain) == [rangers.SPIKE]
    assert chain.whole
    (row,) = [link for link in chain.links if not link.input]
    assert row.maker == ("guard", rangers.SPIKE)
    assert row.last is not None
    assert {effect.together for effect in row.effects} == {row.last + 1 - rangers.SPIKE}


def test_lost_echo_and_threshold_are_blamed_for_the_decision(approaching: Path) -> None:
    step = next(k for k in range(rangers.STEPS) if rangers.approaching(k) == pytest.approx(1.9))

    chain = found(approaching, f"brake/stop.on@{step / 10}")

    assert chain.value is False, "two of the last three are 2 m or more: one echo is lost, one is the threshold itself"
    assert set(sensed(chain)) >= {step - 2, step - 1}
    assert "made finite" in {effect.way for link in chain.sensed for effect in link.effects}
    assert chain.whole


def test_blame_names_the_largest_effect_first(spiky: Path) -> None:
    chain = found(spiky, "smooth/out.value@4")

    assert sensed(chain)[0] == rangers.SPIKE
    nudges = [effect for effect in chain.sensed[0].effects if effect.way == "nudged"]
    assert [effect.fields for effect in nudges] == [("range",)], "its limits change nothing"
    assert next(link.maker for link in chain.links if not link.input) == ("smooth", rangers.SPIKE)


def test_value_that_no_change_reaches_has_no_cause(spiky: Path) -> None:
    asked = "brake/stop.on@3"
    told = CliRunner().invoke(app, ["blame", str(spiky), "--field", asked])

    words = " ".join(told.output.split())
    assert told.exit_code == 1
    assert "decided by" not in words
    assert "not known what decided brake #30: nothing that was tried there changes the value" in words
    assert "by inputs or earlier calls that only change it together, by the code, or by the call's time" in words
    assert "nudged" in words
    answer = json.loads(CliRunner().invoke(app, ["blame", str(spiky), "--field", asked, "--json"]).stdout)
    assert (answer["whole"], answer["sensed"], answer["no_change_shows_at"]) == (False, [], [["brake", 30]])
    assert answer["tried"]["nudged"] >= 2


def test_a_link_beyond_which_nothing_shows_ends_the_chain_where_it_is(spiky: Path) -> None:
    chain = found(spiky, "guard/stop.on@1")

    assert [(effect.way, effect.together) for link in chain.links for effect in link.effects] == [("another", 1)]
    assert chain.loose == [("smooth", 10)]
    assert not chain.whole


def test_changes_that_a_recorded_answer_does_not_fit_could_not_be_tried(spiky: Path) -> None:
    told = CliRunner().invoke(app, ["blame", str(spiky), "--field", "describe/text.text@3"])

    words = " ".join(told.output.split())
    assert told.exit_code == 1
    assert "decided by" not in words
    assert "could not be tried: range of describe #30: describe #30 raises EffectMiss" in words
    assert "changes made a call raise, which shows nothing" in words


def test_outputs_of_nested_graphs_go_by_their_names(tmp_path: Path) -> None:
    (tmp_path / "inner.yaml").write_text(
        "graph: inner\ninputs: {r: RangeReading}\noutputs: {smooth: filter/out}\n"
        'operators:\n  filter: {use: "rangers:Smooth", inputs: {range: r}}\n'
    )
    (tmp_path / "outer.yaml").write_text(
        'graph: outer\noperators:\n  finder: {use: "rangers:Finder"}\n'
        "  a: {use: inner.yaml, inputs: {r: finder/range}}\n"
        '  guard: {use: "rangers:Guard", inputs: {value: a/smooth}}\n'
    )
    path = tmp_path / "run.mcap"
    dataflow.run(load_graph(tmp_path / "outer.yaml"), record=path)

    exported, inner = found(path, "a/smooth.value@2"), found(path, "a/filter/out.value@2")
    assert exported.target == inner.target == ("a/filter", 20)
    assert sensed(exported) == sensed(inner)
    behind = found(path, "guard/stop.on@5")
    assert {link.call.operator for link in behind.links} == {"guard", "a/filter"}


def test_readings_behind_calls_that_decide_together_are_tried_as_others(tmp_path: Path) -> None:
    graph = load_text(
        "graph: hung\noperators:\n  source: {use: 'rangers:Beaten'}\n"
        "  watch: {use: 'rangers:Watch', inputs: {reading: source/reading}}\n"
        "  any: {use: 'rangers:AnyHigh', inputs: {fresh: watch/fresh, beat: source/beat}}\n"
    )
    path = tmp_path / "run.mcap"
    dataflow.run(graph, record=path)

    chain = found(path, "any/high.on@1")

    (row,) = [link for link in chain.links if not link.input]
    assert (row.maker, row.last) == (("any", 5), 6)
    (read,) = chain.sensed  # the one before twice is known by the watch, as what a sensor that hangs gives
    assert [number for _, _, number in read.messages] == [5, 6]
    assert [(effect.way, effect.together) for effect in read.effects] == [("another", 2)]
    assert chain.whole


def test_time_after_the_end_is_reported(spiky: Path) -> None:
    told = CliRunner().invoke(app, ["blame", str(spiky), "--field", "smooth/out.value@1000"])

    assert "made by smooth #59 at 5.900 s, the last one: the recording ends before" in " ".join(told.output.split())
    assert not found(spiky, "smooth/out.value@5.9").late


def test_seconds_of_a_part_count_from_its_beginning(tmp_path: Path) -> None:
    path, part = tmp_path / "run.mcap", tmp_path / "part.mcap"
    dataflow.run(load_text("record: {snapshots: 500ms}\n" + GRAPH % "false"), record=path)
    cut = CliRunner().invoke(app, ["cut", str(path), "-o", str(part), "--from", "1.45", "--to", "3"])
    assert cut.exit_code == 0, cut.output

    with Recording(part) as recording, closing(Debugger(recording, "smooth")) as debugger:
        for seconds in (0.5, 1.2):
            chain = Blame(recording, Field.parse(f"smooth/out.value@{seconds}")).find()
            assert chain.target.number == debugger.number_at(debugger.origin + round(seconds * 1e9))


def test_a_nudge_and_its_opposite_lie_on_either_side() -> None:
    message = FeatureVector(stamp=5, vectors=np.array([[1.0, -2.0, 0.5]]), model="m")

    one, other = (nudged(message, sign=sign)[0].vectors - message.vectors for sign in (1, -1))

    np.testing.assert_allclose(one, -other, rtol=1e-4)
    assert (one != 0).all()


def test_numbers_that_are_not_finite_take_a_neighbour() -> None:
    lost, heard = (RangeReading(stamp=k, frame="f", range=x) for k, x in ((2, math.inf), (1, 0.8)))
    rows = FeatureVector(stamp=1, vectors=np.array([[np.nan, 1.0, -np.inf, 3.0]]), model="m")

    assert made_finite(lost, heard).range == 0.8
    assert made_finite(lost, heard).range_max == math.inf, "the neighbour's is no other"
    assert made_finite(lost, None) is lost
    assert made_finite(rows, None).vectors.tolist() == [[1.0, 1.0, 1.0, 3.0]]


def test_messages_that_follow_each_other_are_one_run() -> None:
    links = [Link(Call("o", 9), 0, "x", ("s", 0, n), 0, None, ()) for n in (7, 3, 2, 4)]

    assert _in_runs(links) == ["s #2 to #4", "s #7"]
