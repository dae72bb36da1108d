"""The sdist holds the project, and the wheel made of it works from an empty folder, graphs and demo included."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

CALL = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build(what: str, source: Path, target: Path) -> Path:
    """Builds without isolation, so without a network: with the setuptools that is installed."""
    command = [sys.executable, "-c", CALL, what, str(target)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stdout + done.stderr
    return target / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def checkout(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the files that are built from."""
    setuptools = pytest.importorskip("setuptools", reason="setuptools is not installed, and nothing is downloaded")
    if int(setuptools.__version__.partition(".")[0]) < 77:
        pytest.skip(f"setuptools {setuptools.__version__} is older than the build needs (77)")
    copy = tmp_path_factory.mktemp("checkout") / "project"
    unwanted = shutil.ignore_patterns(".git", ".venv", "out", "build", "dist", "__pycache__", "*.egg-info", ".*_cache")
    shutil.copytree(repository, copy, ignore=unwanted)
    return copy


@pytest.fixture(scope="module")
def sdist(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("build_sdist", checkout, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("build_wheel", checkout, tmp_path_factory.mktemp("wheel"))


@pytest.mark.long
def test_sdist_holds_the_files_of_the_repository(sdist: Path, repository: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder in ("dataflow", "operators", "graphs", "recordings", "docs", "tests", "tools", "benchmarks"):
        for file in (repository / folder).rglob("*"):
            path = file.relative_to(repository).as_posix()
            if file.suffix in (".py", ".md", ".yaml", ".mcap", ".onnx") and "peers/out" not in path:
                assert path in names, f"{path} is not in the sdist"


def test_the_wheel_carries_the_packages_the_graphs_the_demo_and_the_licence(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"dataflow", "operators"}
    assert {
        "dataflow/shipped/graphs/perception.yaml",
        "dataflow/shipped/graphs/core/perception.yaml",
        "dataflow/shipped/graphs/chaos/plan.yaml",
        "dataflow/shipped/recordings/demo.mcap",
        "dataflow/py.typed",
        "operators/weights/detector.onnx",
    } <= names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert not any("__pycache__" in name for name in names)


@pytest.mark.long
def test_the_wheel_of_the_unpacked_sdist_holds_the_same_as_pip_makes_it(
    wheel: Path, sdist: Path, tmp_path: Path
) -> None:
    with tarfile.open(sdist) as archive:
        safely = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # from Python 3.11.4 on
        archive.extractall(tmp_path / "unpacked", **safely)
    again = build("build_wheel", next((tmp_path / "unpacked").iterdir()), tmp_path)
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as other:
        assert sorted(one.namelist()) == sorted(other.namelist())


@pytest.mark.long
def test_the_wheel_works_from_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)

    def call(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "dataflow.cli.main", *words],
            cwd=empty,
            env={**os.environ, "PYTHONPATH": str(site), "XDG_RUNTIME_DIR": str(tmp_path), "DISPLAY": ""},
            capture_output=True,
            text=True,
            timeout=110,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    listed = json.loads(call("graphs", "--json"))
    assert {Path(graph["file"]).is_relative_to(site) for graph in listed} == {True}
    assert "rerun dataflow-demo.rrd" in call("demo", "--seconds", "1", "-q")
    assert [file.name for file in empty.iterdir()] == ["dataflow-demo.rrd"]
