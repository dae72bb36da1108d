"""Recordings are cut, split and put together by the base install alone: without the packages of any extra."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

RECORDING = Path(__file__).resolve().parent.parent / "recordings_of" / "run.mcap"
BLOCKED = ("av", "cv2", "h5py", "onnxruntime", "pyarrow", "rerun", "rosbags", "scipy")
SCRIPT = f"""
import sys
from pathlib import Path

sys.modules |= dict.fromkeys({BLOCKED!r})
from typer.testing import CliRunner
from dataflow.cli.main import app


def call(*words):
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, (words, done.output, done.exception)


call("cut", sys.argv[1], "--to", 1, "--out", "part.mcap")
call("split", sys.argv[1], "--every", "1s", "--out", "parts")
call("merge", *sorted(Path("parts").iterdir()), "--out", "whole.mcap")
call("filter", "whole.mcap", "--stream", "smooth/*", "--out", "some.mcap")
call("recover", "whole.mcap", "--out", "saved.mcap")
call("info", "saved.mcap")
"""


def test_recordings_are_edited_without_an_extra(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(RECORDING)], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert {file.name for file in tmp_path.iterdir()} == {"part.mcap", "parts", "whole.mcap", "some.mcap", "saved.mcap"}
