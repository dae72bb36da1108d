"""Fixtures that several test packages share."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("repeatable")

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    # As in the processes of a run, and before a library reads it: the threads of two workers on two cores wait for each
    # other in busy loops, for as long again as the work takes.
    os.environ.setdefault(name, "1")

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path += [str(REPOSITORY / "tests" / "support"), str(REPOSITORY / "tools")]


if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a suite in the background, whose programs would ignore it too
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Divides the whole suite among the cores; tests that are named run in this process.

    Each worker takes a contiguous half and then from the other's end, so that what a module's tests share is made once.
    """
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    worker = hasattr(config, "workerinput")  # which would divide its part again, and so on without end
    chosen = config.option.keyword or config.option.markexpr or config.option.usepdb or config.option.collectonly
    if (
        whole
        and not worker
        and not chosen
        and config.pluginmanager.hasplugin("xdist")
        and config.option.numprocesses is None
    ):
        config.option.numprocesses = len(os.sched_getaffinity(0))
        config.option.dist = "worksteal"


@pytest.fixture(scope="session", autouse=True)
def _running_graphs_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keeps the graphs of these tests apart from those that others run on this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        yield


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data, or a skip that says where it was looked for."""
    folder = Path(os.environ.get("PERCEPTION_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"real data not found: no folder {folder} (set PERCEPTION_DATA to where it is)")
    return folder
