"""Modules are sought beside the graph's files, after everything that is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from dataflow.graph import GraphError, load_bundle, load_graph, load_text, search

OPERATOR = """\
from dataflow.messages import Pose
from dataflow.operator import Out, Param, Source


class Here(Source):
    \"\"\"A source.\"\"\"

    pose: Out[Pose] = Out(doc="pose")
    path: str = Param("", doc="a path")
"""


def module(folder: Path, name: str) -> str:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(OPERATOR)
    return f"{name}:Here"


def graph(file: Path, *lines: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join([f"graph: {file.stem}", *lines, ""]))
    return file


def test_a_module_beside_the_graph_is_found_from_any_folder(tmp_path: Path) -> None:
    file = graph(tmp_path / "g.yaml", f"operators: {{a: {{use: '{module(tmp_path, 'beside_the_graph')}'}}}}")

    assert load_graph(file).nodes["a"].use == "beside_the_graph:Here"


def test_a_module_beside_a_nested_graph_is_found(tmp_path: Path) -> None:
    inner = module(tmp_path / "parts", "beside_the_part")
    graph(tmp_path / "parts" / "part.yaml", f"operators: {{a: {{use: '{inner}'}}}}")

    assert "p/a" in load_graph(graph(tmp_path / "g.yaml", "operators: {p: {use: parts/part.yaml}}")).nodes


def test_module_beside_the_graph_shadows_no_installed_one(tmp_path: Path) -> None:
    (tmp_path / "colorsys.py").write_text("raise RuntimeError('hijacked')\n")
    sys.modules.pop("colorsys", None)
    load_graph(graph(tmp_path / "g.yaml", f"operators: {{a: {{use: '{module(tmp_path, 'beside_colorsys')}'}}}}"))
    import colorsys

    assert Path(colorsys.__file__).parent == Path(os.__file__).parent


def test_the_current_folder_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    search.add_current_folder()
    search.add_folder("first")
    search.add_folder("second")

    assert [*map(os.path.basename, sys.path[-3:])] == ["first", "second", tmp_path.name]
    assert sys.path[-3:] == search.FOLDERS


def test_missing_module_names_the_searched_folders(tmp_path: Path) -> None:
    with pytest.raises(GraphError) as caught:
        load_graph(graph(tmp_path / "g.yaml", "operators: {a: {use: 'sensors:Camera'}}"))

    assert "no module 'sensors'" in str(caught.value)
    assert f"looked among the installed packages and in {tmp_path}" in str(caught.value)
    assert "selectors" not in str(caught.value)  # nobody's operators are in the standard library


def test_the_graphs_folder_stands_in_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use = module(tmp_path, "takes_a_path")
    graph(
        tmp_path / "parts" / "part.yaml", f"operators: {{a: {{use: '{use}', params: {{path: '${{graph:folder}}/x'}}}}}}"
    )
    outer = graph(
        tmp_path / "g.yaml",
        "params: {data: '${graph:folder}/../data'}",
        f"operators: {{a: {{use: '{use}', params: {{path: '${{data}}'}}}}, p: {{use: parts/part.yaml}}}}",
    )
    loaded = load_graph(outer)

    assert loaded.nodes["a"].params["path"] == f"{tmp_path}/../data"
    assert loaded.nodes["p/a"].params["path"] == f"{tmp_path}/parts/x"
    assert load_bundle(loaded.bundle()) == loaded

    monkeypatch.chdir(tmp_path.parent)
    relative = load_graph(Path(tmp_path.name) / "g.yaml")
    assert relative.nodes["a"].params["path"] == f"{tmp_path.name}/../data"  # nothing absolute in its recordings
    monkeypatch.chdir(tmp_path)
    assert load_graph("g.yaml").nodes["a"].params["path"] == "./../data"


def test_a_graph_that_does_not_ask_for_its_folder_does_not_keep_it(tmp_path: Path) -> None:
    use = module(tmp_path, "needs_no_folder")
    loaded = load_graph(graph(tmp_path / "g.yaml", f"operators: {{a: {{use: '{use}'}}}}"))

    assert loaded.sources_bundle.folder == ""
    assert load_text("graph: g\noperators: {a: {use: 'needs_no_folder:Here'}}\n").sources_bundle.folder == ""


def test_initial_folder_is_listed_among_the_searched_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])

    search.add_folder(tmp_path)
    search.add_folder(tmp_path)

    assert search.looked_in() == f"looked among the installed packages and in {tmp_path}"
    assert sys.path.count(str(tmp_path)) == 1
