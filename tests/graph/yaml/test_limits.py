"""Graphs of a few lines that would grow without end are refused where they pass a limit, which the message names."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from dataflow.graph import GraphError, Problem, load_bundle, load_graph, load_text
from dataflow.graph.yaml import document, limits
from dataflow.graph.yaml.limits import MAX_BUNDLE, MAX_OPERATORS, MAX_TEXT

HEAD = 'graph: g\noperators:\n  camera: {use: "graph_operators:Camera"}\n'
MEMORY = 1_000_000_000
WITHIN = 30.0


def tens(first: str, name: str, separator: str = ",") -> str:
    """Ten parameters, each ten times the one before."""
    lines = ["graph: g", "params:", f"  a: {first}"]
    for before, after in zip("abcdefghij", "bcdefghijk", strict=True):
        lines.append(f"  {after}: {name.format(after, separator.join(['${' + before + '}'] * 10))}")
    return "\n".join([*lines, "operators:", '  camera: {use: "graph_operators:Camera"}', ""])


def the_problem(text: str, settings: tuple[str, ...] = (), files: dict[str, str] | None = None) -> Problem:
    with pytest.raises(GraphError) as caught:
        load_text(text, settings=settings, files=files)
    (problem,) = caught.value.problems
    assert len(str(problem)) < 5_000
    return problem


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (tens("xxxxxxxxxx", '"{1}"', ""), 7, "more than 40,000 characters"),
        (tens("[1, 1, 1, 1, 1, 1, 1, 1, 1, 1]", "[{1}]"), 6, "the graph has more than 3,000 values"),
        (HEAD + "params: {b: [" + "0," * 1_000 + "]}\n", 4, "the file has more than 1,000 values"),
        (HEAD + "params: {a: " + "[" * 1_500 + "]" * 1_500 + "}\n", 4, "values nest deeper than 64 levels"),
        (HEAD + "params: {a: " + "[" * 100 + "]" * 100 + "}\n", 4, "values nest deeper than 64 levels"),
        (
            f"{HEAD}params:\n  a: {'[' * 50}1{']' * 50}\n  b: {'[' * 50}{'${a}'}{']' * 50}\n",
            6,
            "values nest deeper than 64 levels",
        ),
        (HEAD + "seed: " + "1" * 5_001 + "\n", 4, "whole numbers have 64 bits"),
        (HEAD + "seed: 99999999999999999999\n", 4, "whole numbers have 64 bits"),
        (HEAD + "  c: {use: " + "x" * 900_000 + "}\n", 4, "names no operator"),
        (HEAD + "params: {a: " + "x" * 1_000_000 + "}\n", 1, "the file has more than 1,000,000 characters"),
        ("graph: g\n" + "? " * 10_000 + "\n", 2, "values nest deeper than 64 levels"),
    ],
    ids=[
        "text of texts", "list of lists", "values", "deep", "a little too deep", "deep by reference", "digits", "bits",
        "long word", "long file", "keys of keys",
    ],
)  # fmt: skip
def test_a_graph_that_would_grow_is_refused_at_its_line(
    text: str, line: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, limit in ((document, "MAX_VALUES"), (limits, "MAX_EXPANDED"), (limits, "MAX_EXPANDED_TEXT")):
        monkeypatch.setattr(module, limit, getattr(limits, limit) // 100)  # reached in a hundredth of the time

    problem = the_problem(text)

    assert problem.line == line
    assert said in problem.message


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (tens("xxxxxxxxxx", '"{1}"', ""), 9, "more than 4,000,000 characters"),
        (tens("[1, 1, 1, 1, 1, 1, 1, 1, 1, 1]", "[{1}]"), 8, "the graph has more than 300,000 values"),
        (HEAD + "params: {b: [" + "0," * 100_000 + "]}\n", 4, "the file has more than 100,000 values"),
    ],
    ids=["text of texts", "list of lists", "values"],
)
def test_a_graph_that_would_grow_is_refused_at_the_limits_as_they_are(text: str, line: int, said: str) -> None:
    problem = the_problem(text)

    assert problem.line == line
    assert said in problem.message


def test_nested_graphs_are_limited_in_number_not_only_in_depth() -> None:
    files = {
        f"n{i}.yaml": f"graph: n{i}\noperators:\n" + "".join(f"  a{k}: {{use: n{i + 1}.yaml}}\n" for k in range(10))
        for i in range(1, 6)
    }
    files["n6.yaml"] = HEAD
    problem = the_problem(files["n1.yaml"].replace("n1", "n0"), files=files)

    assert problem.message == f"the graph has more than {MAX_OPERATORS:,} operators"
    assert problem.file.endswith(".yaml")


def test_a_number_of_the_command_line_has_64_bits_too() -> None:
    problem = the_problem(HEAD, ("camera.rate=99999999999999999999",))

    assert (problem.file, problem.line) == ("--set", 1)
    assert "64 bits" in problem.message


def test_a_hundred_faults_are_enough() -> None:
    with pytest.raises(GraphError) as caught:
        load_text(HEAD + "".join(f"k{i}: 1\n" for i in range(5_000)))

    assert len(caught.value.problems) == 101
    assert "the rest of the graph is not read" in str(caught.value)


def test_a_text_of_a_hundred_thousand_references_is_refused() -> None:
    assert "more than 300,000 values" in the_problem(f'{HEAD}params:\n  a: 1\n  b: "{"${a}" * 100_000}"\n').message


def test_an_anchor_that_is_given_twice_is_no_matter(recwarn: pytest.WarningsRecorder) -> None:
    load_text(HEAD + "params: {a: &a 1, b: &a 2, c: *a}\n")

    assert not recwarn.list


def test_a_long_bundle_is_refused_before_it_is_read() -> None:
    with pytest.raises(GraphError, match=r"not a graph bundle.*it may have"):
        load_bundle("[" * (MAX_BUNDLE + 1))
    with pytest.raises(GraphError, match="not a graph bundle"):
        load_bundle("[" * 100_000)


def test_a_device_is_no_graph_file(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="not a regular file"):
        load_graph("/dev/zero")
    long = tmp_path / "long.yaml"
    with long.open("wb") as file:
        file.truncate(10**10)
    with pytest.raises(GraphError, match=f"{MAX_TEXT:,} characters"):
        load_graph(long)


def test_a_graph_that_would_grow_takes_little_memory(tmp_path: Path) -> None:
    """The limits hold in a process that may have one gigabyte."""
    graph = tmp_path / "bomb.yaml"
    graph.write_text(tens("xxxxxxxxxx", '"{1}"', ""))
    told = subprocess.run(
        [sys.executable, "-c", "import sys; from dataflow.graph import load_graph; load_graph(sys.argv[1])", graph],
        capture_output=True,
        text=True,
        timeout=WITHIN,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        env={"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": ":".join(sys.path)},
    )

    assert "GraphError" in told.stderr, told.stderr
    assert "bomb.yaml:9:6" in told.stderr
