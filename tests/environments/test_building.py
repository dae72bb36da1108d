"""Environments built from requirements, by the lock where there is one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from made_environments import packages, wheel

from dataflow.environments import EnvError, environment_of
from dataflow.environments import build as module_of_build
from dataflow.environments.build import build


@pytest.mark.long
def test_an_environment_is_built_from_its_requirements_and_again_from_its_lock(tmp_path: Path) -> None:
    wheel(tmp_path / "wheels", "1.0", 2.0)
    requirements = tmp_path / "gains.txt"
    requirements.write_text(f"--no-index\n--find-links {tmp_path / 'wheels'}\ntiny\n")
    module = packages(tmp_path / "gains.env") / "tiny.py"

    assert build(requirements)
    assert not build(requirements)
    assert environment_of(str(requirements)).folder == tmp_path / "gains.env"
    assert (tmp_path / "gains.lock").read_text().splitlines()[-1] == "tiny==1.0"

    wheel(tmp_path / "wheels", "1.1", 3.0)
    (tmp_path / "gains.env" / "built.lock").unlink()
    assert build(requirements)
    assert module.read_text() == "GAIN = 2.0\n"

    assert build(requirements, anew=True)
    assert module.read_text() == "GAIN = 3.0\n"

    requirements.write_text(f"--no-index\n--find-links {tmp_path / 'wheels'}\ntiny>2\n")
    with pytest.raises(EnvError, match=r"gains.txt does not resolve: .*tiny>2"):
        build(requirements)
    assert module.read_text() == "GAIN = 3.0\n"


def test_a_build_that_fails_leaves_the_environment_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requirements, folder = tmp_path / "gains.txt", tmp_path / "gains.env"
    requirements.write_text("tiny\n")

    def fail(*_: Any) -> None:
        raise EnvError("no network")

    monkeypatch.setattr(module_of_build, "_run", fail)
    folder.mkdir()
    with pytest.raises(EnvError, match=r"gains.env is no environment, and one is to be built there"):
        build(requirements)

    (folder / "pyvenv.cfg").touch()
    for _ in range(2):
        with pytest.raises(EnvError, match="no network"):
            build(requirements, anew=True)
        assert (folder / "pyvenv.cfg").is_file()
        folder.rename(tmp_path / "gains.env.before")  # as a build leaves it that is killed
        folder.mkdir()


@pytest.mark.parametrize(
    "line", ["-r base.txt", "--constraint=c.txt", "-i x", "tiny==1 --hash=sha256:aa", "--require-hashes"]
)
def test_options_that_a_lock_cannot_hold_are_refused(tmp_path: Path, line: str) -> None:
    (tmp_path / "gains.txt").write_text(f"--no-index\ntiny\n{line}\n")
    with pytest.raises(EnvError, match=re.escape(f"gains.txt: {line!r} cannot be locked; options that can: --")):
        build(tmp_path / "gains.txt")
