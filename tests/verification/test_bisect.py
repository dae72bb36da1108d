"""`git bisect run` with the script of the page finds the commit since which a recording is not repeated."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
TRACKER = """
import numpy as np
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source

class Numbers(Source):
    x: Out[FeatureVector]
    def stream(self):
        for k in range(20):
            yield {"x": FeatureVector(stamp=10**18 + k, vectors=np.array([[k]], np.float32), model="m")}

class Tracker(Operator):
    x: In[FeatureVector]
    out: Out[FeatureVector]
    def process(self, x):
        return FeatureVector(stamp=x.stamp, vectors=x.vectors * BODY, model="m")
"""
GRAPH = """
graph: bisected
operators:
  numbers: {use: 'tracked:Numbers'}
  tracker: {use: 'tracked:Tracker', inputs: {x: numbers/x}}
"""
COMMITS = ("2", "2  # a", "2  # b", "2  # c", "(2 +", "2  # d", "3", "3  # e", "3  # f")
"""What each commit multiplies by; one does not compile, the seventh is wrong."""


def git(folder: Path, *words: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    done = subprocess.run(
        ["git", *identity, *words], cwd=folder, capture_output=True, text=True, timeout=300, env=environment(folder)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def environment(folder: Path) -> dict[str, str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return {**os.environ, "PATH": path, "PYTHONPATH": f"{folder}:{REPOSITORY}", "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.mark.long
@pytest.mark.timeout(400)
def test_the_script_of_the_page_finds_the_commit(tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "verification.md").read_text(encoding="utf-8")
    [script] = re.findall(r"```sh\n(#!/bin/sh\ndataflow verify.*?)```", page, re.DOTALL)
    work = tmp_path / "work"
    work.mkdir()
    (tmp_path / "bisect.sh").write_text(script.replace("run.mcap", "../run.mcap"))
    (tmp_path / "graph.yaml").write_text(GRAPH)
    git(work, "init", "--quiet")
    for number, body in enumerate(COMMITS):
        (work / "tracked.py").write_text(TRACKER.replace("BODY, ", f"{body}\n, "))
        git(work, "add", "tracked.py")
        git(work, "commit", "--quiet", "--message", f"commit {number}")
        if number == 0:
            command = ["dataflow", "run", "../graph.yaml", "--record", "../run.mcap", "--one-process", "--quiet"]
            subprocess.run(command, cwd=work, check=True, timeout=100, env=environment(work))

    git(work, "bisect", "start", "HEAD", "HEAD~8")
    git(work, "bisect", "run", "sh", "../bisect.sh")

    told = git(work, "bisect", "log")
    assert "# first bad commit" in told
    assert told.splitlines()[-1].endswith("commit 6")
    assert "# skip: " in told
    assert next(line for line in told.splitlines() if line.startswith("# skip: ")).endswith("commit 4")
