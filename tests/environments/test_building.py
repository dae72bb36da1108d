"""Environments built from requirements, by the lock where there is one."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from made_environments import packages, wheel

from dataflow.environments import EnvError, environment_of, lock
from dataflow.environments import build as module_of_build
from dataflow.environments.build import build


def sha256(folder: Path) -> str:
    """The hash of the wheel of version 1.0."""
    return hashlib.sha256((folder / "wheels" / "tiny-1.0-py3-none-any.whl").read_bytes()).hexdigest()


@pytest.fixture
def requirements(tmp_path: Path) -> Path:
    """Requirements of a package whose version 1.0 lies beside them."""
    wheel(tmp_path / "wheels", "1.0", 2.0)
    path = tmp_path / "gains.txt"
    path.write_text(f"--no-index\n--find-links {tmp_path / 'wheels'}\ntiny\n")
    return path


@pytest.mark.long
def test_an_environment_is_built_from_its_requirements_and_again_from_its_lock(
    requirements: Path, tmp_path: Path
) -> None:
    module = packages(tmp_path / "gains.env") / "tiny.py"

    assert build(requirements)
    assert not build(requirements)
    assert environment_of(str(requirements)).folder == tmp_path / "gains.env"
    assert (tmp_path / "gains.lock").read_text().splitlines()[-1] == f"tiny==1.0 --hash=sha256:{sha256(tmp_path)}"

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


@pytest.mark.long
def test_another_file_of_the_same_version_is_refused(requirements: Path, tmp_path: Path) -> None:
    build(requirements)
    locked = sha256(tmp_path)
    (tmp_path / "gains.env" / "built.lock").unlink()

    wheel(tmp_path / "wheels", "1.0", 666.0)
    other = f"tiny==1.0 is another file than was locked: sha256 {sha256(tmp_path)}, and {locked} is locked"
    with pytest.raises(EnvError, match=rf"gains.lock cannot be installed: {other}.*--anew takes it"):
        build(requirements)
    assert (packages(tmp_path / "gains.env") / "tiny.py").read_text() == "GAIN = 2.0\n"

    assert build(requirements, anew=True)
    assert (packages(tmp_path / "gains.env") / "tiny.py").read_text() == "GAIN = 666.0\n"


@pytest.mark.long
def test_another_kind_of_machine_adds_the_hashes_of_its_files_to_the_same_versions(
    requirements: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel(tmp_path / "wheels", "1.1", 3.0)
    lock.write(requirements, requirements.read_text().splitlines()[:2], {"tiny==1.0": {"a" * 64}}, ["other"])

    assert build(requirements)
    assert (packages(tmp_path / "gains.env") / "tiny.py").read_text() == "GAIN = 2.0\n"
    assert lock.pins(requirements) == {"tiny==1.0": {"a" * 64, sha256(tmp_path)}}
    assert lock.kinds(requirements) == {"other", lock.HERE}
    assert not build(requirements)


def test_folders_and_repositories_are_locked_by_where_they_are_from() -> None:
    def pin(origin: Mapping[str, Any], *, direct: bool = True) -> tuple[str, set[str]]:
        metadata = {"name": "tiny", "version": "1.0"}
        return module_of_build._pin({"metadata": metadata, "is_direct": direct, "download_info": origin})

    at = "https://host/tiny"
    assert pin({"url": at, "vcs_info": {"vcs": "git", "commit_id": "ab12"}}) == (f"tiny @ git+{at}@ab12", set())
    assert pin({"url": "file:///tiny", "dir_info": {}}) == ("tiny @ file:///tiny", set())
    whole = {"url": f"{at}.whl", "archive_info": {"hashes": {"sha256": "cd"}}}
    assert pin(whole) == (f"tiny @ {at}.whl", {"cd"})
    assert pin(whole, direct=False) == ("tiny==1.0", {"cd"})


def test_failed_build_leaves_the_environment_unchanged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
