"""Environments built from requirements, by the lock where there is one."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_environments import packages, wheel

from dataflow.environments import EnvError, environment_of
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
    assert not (tmp_path / "gains.env").exists()
