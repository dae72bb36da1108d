"""Fixtures that several test packages share."""

from __future__ import annotations

import ast
import fcntl
import gc
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import hypothesis
import pytest
from _pytest.mark.expression import Expression

hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("repeatable")

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    # As in the processes of a run, and before a library reads it: the threads of two workers on two cores wait for each
    # other in busy loops, for as long again as the work takes.
    os.environ.setdefault(name, "1")

REPOSITORY = Path(__file__).resolve().parent.parent
TESTS = REPOSITORY / "tests"
ROOMS = {
    "docs": ("docs", "scaffold"),
    "network": ("client", "foxglove", "machines", "transport"),
    "process": (
        "analysis", "api", "blame", "capture", "causes", "cli", "debugging", "doctor", "drops", "editing",
        "environments", "graphs", "operators/perception", "operators/training", "process", "program", "recordings_of",
        "runtime", "shipped",
        "simulation", "supervision", "tool_server", "verification",
    ),
}  # fmt: skip
"""Folders of tests by marker; a test anywhere else is a `unit` test."""
SLOW = pytest.StashKey[set[str]]()
"""Libraries that take long to import and were imported when tests were collected."""
sys.path += [str(REPOSITORY / "tests" / "support"), str(REPOSITORY / "tools")]


if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a suite in the background, whose programs would ignore it too
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run the long tests too, as those named always are")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Divides the whole suite among the cores, without long tests; tests that are named run in this process, all.

    Each worker takes a contiguous half and then from the other's end, so that what a module's tests share is made once.
    """
    if hasattr(config, "workerinput"):  # it would divide its part again, and so on without end
        return
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    config.option.long = config.option.long or not whole or bool(config.option.keyword)
    chosen = config.option.keyword or config.option.usepdb or config.option.collectonly
    if whole and not chosen and config.pluginmanager.hasplugin("xdist") and config.option.numprocesses is None:
        config.option.numprocesses = len(os.sched_getaffinity(0))
        config.option.dist = "worksteal"


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Spares the garbage collector what collection makes: it all stays until the end. Tests make much that does not."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 10, 10)  # instead of 700: a seventh of the time of tests that draw many examples
        gc.enable()
        session.config.stash[SLOW] = {"mcp", "open3d", "pandas", "rerun", "scipy.stats", "torch"} & sys.modules.keys()


@cache
def marker_of(path: Path) -> str:
    """Returns the marker of the tests in a file or folder, by the room that it lies in."""
    inside = path.relative_to(TESTS)
    return next((name for name, rooms in ROOMS.items() if any(inside.is_relative_to(room) for room in rooms)), "unit")


def pytest_itemcollected(item: pytest.Item) -> None:
    item.add_marker(marker_of(item.path))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves long tests out of a whole suite without `--long`."""
    if not config.option.long:
        left_out = [item for item in items if item.get_closest_marker("long")]
        items[:] = [item for item in items if not item.get_closest_marker("long")]
        config.hook.pytest_deselected(items=left_out)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leaves out files of which `-m` selects no test, before they import anything."""
    named = set(re.findall(r"\w+", config.option.markexpr)) - {"and", "or", "not"}
    if collection_path.suffix != ".py" or not named or not named <= {"unit", *ROOMS}:
        return None
    wanted = Expression.compile(config.option.markexpr).evaluate(lambda name, **_: name == marker_of(collection_path))
    return None if wanted else True


@pytest.fixture(scope="session", autouse=True)
def _running_graphs_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keeps the graphs of these tests apart from those that others run on this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        yield


@pytest.fixture(scope="module", autouse=True)
def _late_imports(request: pytest.FixtureRequest) -> None:
    """Imports what a module of tests names under `if TYPE_CHECKING:` when its first test runs: torch takes seconds.

    Nothing of that is imported when tests are collected, and where an extra is not installed the tests are skipped.
    """
    source = request.path.read_text(encoding="utf-8")
    for node in ast.parse(source).body if "TYPE_CHECKING" in source else ():
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), request.path, "exec"), vars(request.module))


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Makes files that tests only read, once for all workers: `once(name, make)` is a folder that `make` filled."""
    session = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        session = session.parent

    def folder_of(name: str, make: Callable[[Path], object]) -> Path:
        folder = session / f"once_{name}"
        with folder.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.with_suffix(".made").exists():
                folder.mkdir(exist_ok=True)
                make(folder)
                folder.with_suffix(".made").touch()
        return folder

    return folder_of


@pytest.fixture(scope="session")
def imported_by_collection(pytestconfig: pytest.Config) -> set[str]:
    """Libraries that take long to import and that some module of tests imports when it is collected."""
    return pytestconfig.stash[SLOW]


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


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets verification call its workers' functions in this process: for tests of its verdicts."""
    from dataflow.api.in_process import call_here
    from dataflow.verification import verify

    monkeypatch.setattr(verify, "call_workers", call_here)
