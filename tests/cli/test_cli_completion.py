"""The shell completes commands, options, graphs and what runs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dataflow.cli.commands import completion
from dataflow.transport.registry import register

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a `dataflow` as the console script is."""
    folder = tmp_path_factory.mktemp("bin")
    script = folder / "dataflow"
    script.write_text(f"#!{sys.executable} -P\nfrom dataflow.cli.start import main\nmain()\n")
    script.chmod(0o755)
    return folder


def completed(program: Path, line: str) -> list[str]:
    """The words that bash offers at the end of a line."""
    ask = (
        'eval "$(dataflow completion bash)"; read -ra COMP_WORDS <<< "$LINE"; '
        '[[ "$LINE" == *" " ]] && COMP_WORDS+=(""); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); '
        '_dataflow_completion dataflow; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    path = f"{program}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(REPOSITORY), "LINE": line}
    done = subprocess.run(
        [shutil.which("bash") or "bash", "--norc", "-c", ask],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.long
@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
def test_bash_completes_commands_options_and_graphs(program: Path) -> None:
    assert {"verify", "view"} <= set(completed(program, "dataflow ve")) | set(completed(program, "dataflow vi"))
    assert "--overwrite" in completed(program, "dataflow run --over")
    assert completed(program, "dataflow run synth") == ["synthetic_rgbd"]
    assert completed(program, "dataflow param s") == ["set"]


def test_names_of_running_graphs_are_completed() -> None:
    streams = [{"name": "robot1/camera/image"}, {"name": "robot1/cloud/cloud"}]
    graph = {"streams": streams, "nodes": [{"name": "camera"}, {"name": "cloud"}]}
    with register("watch", "robot1", ["unixsock-stream//x"], graph):
        assert list(completion.running_graphs("w")) == ["watch"]
        assert list(completion.running_streams("cam")) == ["camera/image"]
        assert list(completion.running_operators("cl")) == ["cloud"]
    assert list(completion.running_graphs("w")) == []


def test_a_script_for_every_shell_is_printed_and_others_are_refused(dataflow, monkeypatch) -> None:
    for shell in completion.SHELLS:
        assert completion.VARIABLE in dataflow("completion", shell).stdout
    monkeypatch.setenv("SHELL", "/bin/zsh")
    assert "compdef" in dataflow("completion").stdout
    monkeypatch.setenv("SHELL", "/bin/tcsh")
    assert "expected one of bash" in dataflow("completion", code=2).stderr


def test_it_is_set_up_for_the_user(dataflow, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert "from its next start on" in dataflow("completion", "bash", "--install").stdout
    written = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert any("dataflow" in file.read_text() for file in written)
