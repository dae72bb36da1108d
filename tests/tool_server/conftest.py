"""Runs of two operators with bugs, recorded with them and without; and of one that prints."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import zoo

import dataflow
from dataflow.graph import load_text
from dataflow.graph.search import add_folder

ZOO = str(Path(zoo.__file__).resolve().parent.parent)

LOUD = """
import os

import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source


class Numbers(Source):
    x: Out[FeatureVector]

    def stream(self):
        for k in range(300):
            yield {"x": FeatureVector(stamp=10**18 + k * 10**7, vectors=np.array([[k]], np.float32), model="made")}


class Loud(Operator):
    stateless = True
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x):
        print("printed by Python")
        os.write(1, b"written by a library\\n")
        return {"y": x}
"""


@pytest.fixture(scope="session")
def bugs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A recording by right code, and one by the code with bugs; here the code has its bugs, unless ZOO_FIXED is set."""
    graph = load_text(
        "graph: bugs\nrecord: {snapshots: 100ms}\noperators:\n"
        "  src: {use: 'zoo.bugs:Numbers', params: {steps: 700}}\n"
        "  sum: {use: 'zoo.bugs:Skips', inputs: {x: src/x}}\n"
        "  sine: {use: 'zoo.bugs:WrongUnit', inputs: {x: src/x}}\n"
    )
    folder = tmp_path_factory.mktemp("bugs")
    dataflow.run(graph, record=folder / "wrong.mcap")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZOO_FIXED", "1")
        dataflow.run(graph, record=folder / "right.mcap")
    return {name: str(folder / f"{name}.mcap") for name in ("right", "wrong")}


@pytest.fixture(scope="session")
def loud(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A recording with an operator that prints, and the folder of its module."""
    folder = tmp_path_factory.mktemp("loud")
    (folder / "loud_operators.py").write_text(LOUD)
    add_folder(folder)
    graph = load_text(
        "graph: loud\noperators:\n  numbers: {use: 'loud_operators:Numbers'}\n"
        "  loud: {use: 'loud_operators:Loud', inputs: {x: numbers/x}}\n"
    )
    dataflow.run(graph, record=folder / "run.mcap")
    return str(folder / "run.mcap"), os.fspath(folder)
