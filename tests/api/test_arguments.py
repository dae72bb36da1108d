"""Arguments of a wrong type are named in a sentence: the function, the argument, what is expected, what was given."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from typer.testing import CliRunner
from watched import Camera, Judge, Photometer

import dataflow
from dataflow.arguments import checked, describe, find_fault
from dataflow.cli.main import app
from dataflow.messages import Number
from dataflow.reexecution.recorded_run import ReplayError


def watch() -> dataflow.Graph:
    graph = dataflow.Graph("watch", namespace="shop", seed=7)
    graph.add("camera", Camera).add("meter", Photometer, gain=2.0).add("judge", Judge)
    return graph.connect("meter", image="camera/image").connect(
        "judge", brightness="meter/brightness", exposure="camera/exposure"
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("only", "operators"),
    [("meter", ["meter"]), (["judge"], ["judge"]), (["meter", "judge"], ["meter", "judge"]), (("meter",), ["meter"])],
)
def test_verify_takes_one_operator_or_several(tmp_path: Path, only: Any, operators: list[str]) -> None:
    path = tmp_path / "run.mcap"
    watch().run(record=path)

    found = dataflow.verify(path, only=only, jobs=1)
    assert found.identical
    assert [v.operator for v in found.report.operators] == operators


def test_verify_takes_the_first_operator_of_those_to_verify(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    watch().run(record=path)

    assert [v.operator for v in dataflow.verify(path, first="meter", jobs=1).report.operators] == ["meter", "judge"]
    with pytest.raises(ReplayError, match="first and only exclude each other"):
        dataflow.verify(path, first="meter", only="judge")
    with pytest.raises(ReplayError, match="only: expected at least one operator"):
        dataflow.verify(path, only=[])
    with pytest.raises(ReplayError, match=r"'metre' cannot be verified: .*those that can: judge, meter"):
        dataflow.verify(path, only=["meter", "metre"])


CALLS: dict[str, tuple[Callable[[Path], object], str]] = {
    "open": (lambda p: dataflow.open(3), r"open\(\): path: expected a text or a path, got 3 \(int\)"),
    "run: graph": (
        lambda p: dataflow.run(7),
        r"run\(\): graph: expected a GraphBuilder, a Graph, a text or a path, got 7 \(int\)",
    ),
    "run: settings": (
        lambda p: dataflow.run("graph.yaml", settings=["camera.rate=3"]),
        r"run\(\): settings: expected a dictionary from texts to values or None, got \['camera.rate=3'\] \(list\)",
    ),
    "run: watch": (
        lambda p: dataflow.run("graph.yaml", watch=True),
        r"run\(\): watch: expected a function or None, got True \(bool\)",
    ),
    "replay: clock": (
        lambda p: dataflow.replay(p, clock="headers"),
        r"replay\(\): clock: expected 'auto', 'header' or 'log', got 'headers' \(str\)",
    ),
    "replay: start": (
        lambda p: dataflow.replay(p, start="3 s"),
        r"replay\(\): start: expected a number or None, got '3 s' \(str\)",
    ),
    "replay: maps": (
        lambda p: dataflow.replay(p, maps={"/camera": 3}),
        r"replay\(\): maps\['/camera'\]: expected a text, got 3 \(int\)",
    ),
    "launch: live": (
        lambda p: dataflow.launch(watch(), live="yes"),
        r"launch\(\): live: expected True or False, got 'yes' \(str\)",
    ),
    "launch: option": (
        lambda p: dataflow.launch(watch(), placment="graph"),
        r"launch\(\): no option 'placment': did you mean 'placement'",
    ),
    "launch: rate": (
        lambda p: dataflow.launch(watch(), rate="fast"),
        r"launch\(\): rate: expected a number or None, got 'fast' \(str\)",
    ),
    "verify: only": (
        lambda p: dataflow.verify(p, only=3),
        r"verify\(\): only: expected a text, a sequence of texts or None, got 3 \(int\)",
    ),
    "verify: only holds": (
        lambda p: dataflow.verify(p, only=["meter", None]),
        r"verify\(\): only\[1\]: expected a text, got None",
    ),
    "verify: jobs": (
        lambda p: dataflow.verify(p, jobs=1.5),
        r"verify\(\): jobs: expected a whole number or None, got 1.5 \(float\)",
    ),
    "Session: outputs": (
        lambda p: dataflow.Session(watch(), outputs="meter/brightness"),
        r"Session\(\): outputs: expected a list of texts or None, got 'meter/brightness' \(str\)",
    ),
    "Session: static": (
        lambda p: dataflow.Session(watch(), static={"camera/info": 3}),
        r"Session\(\): static\['camera/info'\]: expected a Message, got 3 \(int\)",
    ),
    "play": (
        lambda p: dataflow.play(Photometer(), {"image": [3]}),
        r"play\(\): streams\['image'\]\[0\]: expected a Message, got 3 \(int\)",
    ),
    "play: a class": (
        lambda p: dataflow.play(Photometer),
        r"play\(\): operator: expected an Operator, got the class Photometer",
    ),
    "Graph": (
        lambda p: dataflow.Graph(threads="2"),
        r"Graph\(\): threads: expected a whole number, got '2' \(str\)",
    ),
    "Graph.add": (
        lambda p: dataflow.Graph().add(Camera, "camera"),
        r"Graph\.add\(\): name: expected a text, got the class Camera",
    ),
    "Graph.connect": (
        lambda p: watch().connect("meter", image=3),
        r"Graph\.connect\(\): image: expected a text or a list of texts, got 3 \(int\)",
    ),
    "Graph.record": (
        lambda p: watch().record("a", 3),
        r"Graph\.record\(\): topics\[1\]: expected a text, got 3 \(int\)",
    ),
}


@pytest.mark.parametrize("call", CALLS)
def test_a_wrong_type_is_named_before_anything_is_done(tmp_path: Path, call: str) -> None:
    made, sentence = CALLS[call]
    with pytest.raises(TypeError, match=f"^{sentence}"):
        made(tmp_path / "none.mcap")


def test_recordings_and_streams_name_wrong_types(recording: dataflow.RecordedStreams) -> None:
    name = next(iter(recording))
    stream = recording[name]
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: recording[3], r"__getitem__\(\): name: expected a text, got 3"),
        (lambda: recording.select([name]), r"select\(\): names\[0\]: expected a text, got \["),
        (lambda: recording.between("0"), r"between\(\): start: expected a number or None, got '0'"),
        (lambda: recording.within(0.5), r"within\(\): first: expected a whole number or None, got 0.5"),
        (lambda: recording.join(name, direction="near"), r"join\(\): direction: expected 'backward', 'forward' or 'ne"),
        (lambda: stream[0.5], r"expected a place, a slice, or a field's name, got 0.5"),
        (lambda: stream.column(0), r"column\(\): field: expected a text, got 0"),
        (lambda: stream.frame(["stamp"]), r"frame\(\): fields\[0\]: expected a text"),
        (lambda: stream.at("now"), r"at\(\): seconds: expected a number, got 'now'"),
    ]
    for call, sentence in wrong:
        with pytest.raises(TypeError, match=sentence):
            call()


def test_session_put_refuses_arguments_of_wrong_type() -> None:
    with dataflow.Session(watch()) as session:
        with pytest.raises(
            TypeError, match=r"Session\.put\(\): messages: expected a dictionary from texts to Messages"
        ):
            session.put(1, Number(stamp=1, value=1.0))
        with pytest.raises(TypeError, match=r"Session\.put\(\): stamp: expected a whole number, got 0.5"):
            session.put(0.5, {})


FITS: list[tuple[Any, Any]] = [
    (np.float32(1.5), float),
    (np.int64(3), int),
    (np.int64(3), float),
    (np.True_, bool),
    (Path("a"), Path),
    ("a", str | Path),
    (None, int | None),
    ((n for n in "ab"), Iterable[str]),
    ({"a": [1]}, Mapping[str, Sequence[int]]),
    ([], Sequence[str]),
    (Camera, type[dataflow.Graph] | type),
    ("header", Literal["auto", "header"]),
    (print, Callable[[str], None]),
    (object(), Any),
]


@pytest.mark.parametrize(("value", "wanted"), FITS)
def test_values_fitting_a_type_are_accepted(value: Any, wanted: Any) -> None:
    assert find_fault(value, wanted, "it") is None


@pytest.mark.parametrize(
    ("value", "wanted", "place"),
    [
        (True, int, "it"),
        ("ab", Sequence[str], "it"),
        ({"a": [1, "b"]}, Mapping[str, Sequence[int]], "it['a'][1]"),
        ({3: []}, Mapping[str, Sequence[int]], "a key of it"),
        (["a", 3], str | Sequence[str], "it[1]"),
        (int, type[dataflow.Graph], "it"),
    ],
)
def test_the_innermost_place_of_a_fault_is_named(value: Any, wanted: Any, place: str) -> None:
    fault = find_fault(value, wanted, "it")
    assert fault is not None
    assert fault.place == place


def test_unknown_arguments_are_left_to_the_call() -> None:
    @checked
    def sized(width: int, *, height: int = 0) -> int:
        return width * height

    assert sized(2, height=3) == 6
    with pytest.raises(TypeError, match="unexpected keyword argument 'heigth'"):
        sized(2, heigth=3)
    assert describe(Sequence[float]) == "a sequence of numbers"


def test_the_command_takes_only_several_times(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    watch().run(record=path)

    shown = CliRunner().invoke(app, ["verify", str(path), "--only", "meter", "--only", "judge", "--json", "-j", "1"])
    assert shown.exit_code == 0, shown.output
    assert {operator["operator"] for operator in json.loads(shown.stdout)["operators"]} == {"meter", "judge"}
