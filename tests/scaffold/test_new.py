"""What `dataflow new` writes passes its own tests."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from textwrap import indent

import pytest
from cli_commands import call

from dataflow.graph import load_graph
from dataflow.scaffold.files import KINDS, InvalidName, camel, operator_files, snake

COMPILER = shutil.which("c++")
REPOSITORY = Path(__file__).resolve().parents[2]


def run_tests(folder: Path, runtime: Path) -> str:
    """pytest in that folder, in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "XDG_RUNTIME_DIR": str(runtime)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "addopts="]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.long
def test_a_project_passes_its_own_tests(tmp_path: Path) -> None:
    told = call("new", "project", "my-robot", "--to", tmp_path).stdout
    project = tmp_path / "my-robot"

    assert "pytest && dataflow run graphs/my_robot.yaml" in told
    readme = (project / "README.md").read_text(encoding="utf-8")
    assert [line.partition("#")[0].split()[-1] for line in readme.splitlines() if "pip" in line] == [
        '"PATH/TO/robot-dataflow[all]"',
        '".[dev]"',
    ]
    for kind in KINDS:
        call("new", "operator", f"Another{kind}", "--kind", kind, "--to", project / "my_robot")
    call("new", "graph", "second", "--to", project / "graphs")
    assert (project / "tests" / "test_anothersource.py").is_file()
    assert f"{12 if COMPILER else 11} passed" in run_tests(project, tmp_path)


def test_operators_begin_in_any_folder_and_pass_their_tests(tmp_path: Path) -> None:
    for kind in KINDS:
        call("new", "operator", f"My{kind.title()}", "--kind", kind, "--to", tmp_path)
    assert {file.name for file in tmp_path.glob("*.py")} == {
        *(f"my_{kind}.py" for kind in KINDS),
        *(f"test_my_{kind}.py" for kind in KINDS),
    }
    call("new", "operator", "Second", "--kind", "program", "--to", tmp_path)
    assert f"{7 if COMPILER else 5} passed" in run_tests(tmp_path, tmp_path)
    (tmp_path / "dataflow.hpp").write_text("mine")
    assert "is there already" in call("new", "operator", "x", "--kind", "program", "--to", tmp_path, code=2).stderr


def test_generated_files_pass_ruff(tmp_path: Path) -> None:
    ruff = Path(sys.executable).parent / "ruff"
    if not ruff.is_file():
        pytest.skip("ruff (the [dev] extra) is not installed")
    call("new", "project", "neat", "--to", tmp_path)
    for kind in KINDS:
        call("new", "operator", f"other_{kind}", "--kind", kind, "--to", tmp_path / "neat" / "neat")
    settings = ["--config", str(REPOSITORY / "pyproject.toml")]
    for words in (["format", "--check", *settings], ["check", *settings, "--ignore", "I"]):
        done = subprocess.run([str(ruff), *words, str(tmp_path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


def test_a_graph_is_sound(tmp_path: Path) -> None:
    files = json.loads(call("new", "graph", "ObstacleWatch", "--to", tmp_path, "--json").stdout)["files"]
    assert files == [str(tmp_path / "obstacle_watch.yaml")]
    assert set(load_graph(files[0]).nodes) == {"camera", "cloud"}


def test_nothing_that_is_there_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text("precious")
    assert "is there already" in call("new", "operator", "mine", "--to", tmp_path, code=2).stderr
    assert not (tmp_path / "mine.py").exists()
    assert (tmp_path / "test_mine.py").read_text() == "precious"
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "notes").touch()
    assert "not empty" in call("new", "project", "robot", "--to", tmp_path, code=2).stderr


@pytest.mark.parametrize(
    ("name", "words"),
    [("select", "taken"), ("class", "taken"), ("3d", "cannot be"), ("dataflow", "taken"), ("ü", "cannot")],
)
def test_a_name_that_python_has_already_is_refused(name: str, words: str) -> None:
    with pytest.raises(InvalidName, match=words):
        snake(name)
    assert words in call("new", "operator", name, code=2).stderr
    assert (
        "expected one of operator, timer, source, program" in call("new", "operator", "x", "--kind", "y", code=2).stderr
    )


@pytest.mark.parametrize(
    ("name", "module", "kind"),
    [
        ("NearestObstacle", "nearest_obstacle", "NearestObstacle"),
        ("nearest-obstacle", "nearest_obstacle", "NearestObstacle"),
        ("IMUFilter", "imu_filter", "ImuFilter"),
        ("lidar2d", "lidar2d", "Lidar2d"),
    ],
)
def test_names_of_modules_and_classes(name: str, module: str, kind: str) -> None:
    assert (snake(name), camel(name)) == (module, kind)


GRAPH = "graph: patrol\noperators:\n  camera: {use: operators.sources:SyntheticRgbd}\n"


def test_the_services_of_a_graph_over_two_machines_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("laptop", "robot"):
        Path(name).mkdir()
        for file in ("authority.pem", "certificate.pem", "key.pem"):
            Path(name, file).write_text("made elsewhere")
    two = GRAPH.replace("SyntheticRgbd}", "SyntheticRgbd, machine: robot}")
    Path("patrol.yaml").write_text(two)
    given = ("--listen", "tls/192.168.1.2:7447", "--keys", "laptop")

    assert "operators run on robot: give --listen" in call("new", "service", "patrol.yaml", code=2).stderr
    call("new", "service", "patrol.yaml", *given)
    call("new", "agent", "robot", "--connect", "tls/192.168.1.2:7447", "--keys", "robot", "--user", "root")

    unit = Path("patrol.service").read_text()
    assert f"--listen tls/192.168.1.2:7447 --keys {tmp_path}/laptop --record" in unit
    joins = Path("dataflow-robot.service").read_text()
    assert (
        f"join robot --connect tls/192.168.1.2:7447 --keys {tmp_path}/robot --folder {tmp_path}/dataflow-agent" in joins
    )
    assert "tmpfiles" not in joins
    wrong = call("new", "agent", "robot", "--connect", "tcp/x:1", "--keys", "robot", code=2).stderr
    assert "expected tls/<address>:<port>" in wrong


@pytest.mark.parametrize("flight", [False, True])
def test_a_service_is_a_unit_that_systemd_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flight: bool) -> None:
    folder = tmp_path / "my robot 100%"
    folder.mkdir()
    monkeypatch.chdir(folder)
    (folder / "patrol.yaml").write_text(GRAPH + ("record: {keep: 60s, folder: kept}\n" if flight else ""))

    call("new", "service", "patrol.yaml", "--user", "root", "--days", "3")

    unit = (folder / "patrol.service").read_text()
    assert ("--keep-disk 20GB" in unit) == (not flight)
    kept = (folder / "patrol.conf").read_text().splitlines()[-1]
    assert kept == f'e "{str(folder).replace("%", "%%")}/{"kept" if flight else "out"}" - - - 3d'
    assert "is there already" in call("new", "service", "patrol.yaml", code=2).stderr
    assert "cannot be the name" in call("new", "service", "patrol.yaml", "--name", "a b", code=2).stderr
    if (analyze := shutil.which("systemd-analyze")) is not None:
        monkeypatch.setenv("SYSTEMD_LOG_LEVEL", "warning")
        done = subprocess.run(
            [analyze, "verify", folder / "patrol.service"], capture_output=True, text=True, timeout=60
        )
        about = [line for line in done.stderr.splitlines() if "patrol" in line]
        assert (done.returncode, about) == (0, [])


def test_page_shows_the_generated_files() -> None:
    page = (REPOSITORY / "docs" / "other-languages.md").read_text(encoding="utf-8")
    files = operator_files("Brightness", "program")
    shown = re.search(r"```cpp\n(.*?)```", page, re.DOTALL)
    assert shown is not None
    assert indent(shown[1], "    ") in files[Path("brightness.cpp")]
    declared = files[Path("brightness.py")].split("    stateless = True\n")[1]
    assert declared.strip() in page
