"""The graphs of docs/graphs.md load, and its example of errors is what the loader prints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dataflow.graph import GraphError, load_text

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "graphs.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"```yaml\n(?=# file: (\S+)\n)(.*?)```", PAGE, re.DOTALL))
LOADED = [name for name, text in FILES.items() if name != "wrong.yaml" and "\ninputs:" not in text]


def test_every_yaml_block_names_its_file() -> None:
    assert PAGE.count("```yaml") == len(FILES) >= 5


@pytest.mark.parametrize("name", LOADED)
def test_documented_graph_passes_the_check(name: str) -> None:
    graph = load_text(FILES[name], file=name, files=FILES)
    assert graph.nodes


def test_documented_errors_are_those_of_the_loader() -> None:
    (documented,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    with pytest.raises(GraphError) as caught:
        load_text(FILES["wrong.yaml"], file="wrong.yaml")
    assert str(caught.value) == documented.rstrip("\n")
