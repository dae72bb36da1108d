"""What an operator's code reads is logged with its line, and is the same in every process where it is fixed."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dataflow.causes import sources
from dataflow.causes.interventions import _step, changed
from dataflow.causes.sources import CHANCE

HERE = Path(__file__).resolve().parent
SOURCE = (HERE / "chancy.py").read_text().splitlines()
LOG = """
import json
from dataflow.causes.places import Places
from dataflow.causes.traps import Traps
traps = Traps(Places([{module!r}]))
traps.set()
import {module}
{module}.read()
traps.lift()
print(json.dumps([[source, site.file, site.line, site.call, count] for (source, site), count in traps.counts.items()]))
"""
FIX = """
from dataflow.causes.interventions import Interventions
from dataflow.causes.places import Places
interventions = Interventions(Places([{module!r}]), 1_700_000_000_000_000_000)
interventions.fix({fixed!r})
interventions.vary({varied!r})
import {module}
interventions.number_objects()
print({module}.read())
"""

NAMES = {"datetime": datetime, "UUID": str}


def ran(program: str, **more: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path]), "CHANCY": "7", **more}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=100, check=False
    )
    assert not done.returncode, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def logged() -> set[tuple[str, str]]:
    """The sources that were logged, each with the text of its line."""
    found = json.loads(ran(LOG.format(module="chancy")))
    assert {file for _, file, *_ in found} == {str(HERE / "chancy.py")}
    return {(source, SOURCE[line - 1].strip()) for source, _, line, _, _ in found}


@pytest.mark.parametrize(
    ("source", "line"),
    [
        (sources.WALL, '"time": time.time(),'),
        (sources.WALL, '"bound time": now(),'),
        (sources.WALL, '"datetime": datetime.now(),'),
        (sources.WALL, '"date": date.today(),'),
        (sources.WALL, '"factory": Stamped().made,'),
        (sources.WALL, '"log record": logging.makeLogRecord({}).created,'),
        (sources.MONOTONIC, '"monotonic": time.monotonic_ns(),'),
        (sources.RANDOM, '"python": random.Random().random(),'),
        (sources.RANDOM, "AT_LOAD = drawn()"),
        (sources.NUMPY, '"numpy": np.random.default_rng().normal(),'),
        (sources.NUMPY, "NUMPY_AT_LOAD = np.random.normal()"),
        (sources.UUID, '"uuid": uuid4(),'),
        (sources.UUID, '"uuid by module": uuid.uuid1(),'),
        (sources.ENTROPY, '"urandom": os.urandom(5),'),
        (sources.ENTROPY, '"secrets": secrets.token_hex(3),'),
        (sources.ENTROPY, '"system": random.SystemRandom().random(),'),
        (sources.IDENTITY, '"id": id(order),'),
        (sources.PROCESS, '"pid": os.getpid(),'),
        (sources.HEAP, '"empty": np.empty(3000).tobytes()[-4:],'),
        (sources.THREADS, "thread.start()"),
        (sources.named(sources.VARIABLE, "CHANCY"), '"variable": os.environ.get("CHANCY"),'),
        (sources.named(sources.FILE, str(HERE / "chancy.py")), '"file": open(__file__).readline()[:9],'),
    ],
)
def test_a_call_is_logged_with_its_line(logged: set[tuple[str, str]], source: str, line: str) -> None:
    assert (source, line) in logged


def test_waits_of_the_standard_library_are_no_clock_of_the_operator(logged: set[tuple[str, str]]) -> None:
    assert not [line for _, line in logged if "wait" in line]


def test_fixed_sources_alone_are_equal_in_every_process() -> None:
    fixed = FIX.format(module="chancy", fixed=set(CHANCE), varied=set())
    free = FIX.format(module="chancy", fixed=set(), varied=set())

    one, other, third, fourth = (eval(ran(p), NAMES) for p in (fixed, fixed, free, free))

    assert one == other
    assert one["datetime is itself"]
    same = {key for key in third if third[key] == fourth[key]}
    assert same <= {"datetime is itself", "date", "empty", "variable", "file", "order", "waits", "engine"}


@pytest.mark.parametrize(
    ("free", "changes"),
    [
        (sources.UUID, {"uuid", "uuid by module"}),
        (sources.NUMPY, {"numpy", "numpy at load"}),
        (sources.RANDOM, {"python", "at load"}),
        (sources.ENTROPY, {"urandom", "secrets", "system"}),
    ],
)
def test_a_source_that_is_left_free_is_free_alone(free: str, changes: set[str]) -> None:
    programs = (
        FIX.format(module="chancy", fixed=set(CHANCE), varied=set()),
        FIX.format(module="chancy", fixed=set(CHANCE) - {free}, varied=set()),
    )

    one, other = (eval(ran(p), NAMES) for p in programs)

    assert {key for key in one if one[key] != other[key]} == changes


def test_fixed_values_are_noted_when_compiled_code_reads_them() -> None:
    program = FIX.format(module="given", fixed=set(CHANCE), varied=set()) + "print(interventions.given)"

    sorted_by_id, given = ran(program).splitlines()

    assert eval(given) == {sources.IDENTITY, sources.ADDRESSES, sources.WALL}
    assert eval(sorted_by_id) == sorted(eval(sorted_by_id))


CALM = {
    **{key: [0.0] * 40 for key in ("wall", "monotonic", "timer", "log")},
    **{key: [False] * 40 for key in ("urandom", "random", "numpy")},
    **{key: list(range(5)) for key in ("id", "hash")},
    **{key: [0, 1, 2] for key in ("threads", "pool")},
}
"""The results of two quiet runs of `agreeing`, as a rule."""


@pytest.mark.parametrize(
    ("source", "changes"),
    [
        (sources.WALL, {"wall", "log"}),
        (sources.MONOTONIC, {"monotonic", "timer"}),
        (sources.RANDOM, {"random"}),
        (sources.NUMPY, {"numpy"}),
        (sources.ENTROPY, {"urandom"}),
        (sources.IDENTITY, {"id"}),
        (sources.ADDRESSES, {"hash"}),
    ],
)
@pytest.mark.parametrize("fixed", [False, True])
def test_a_change_shows_where_real_runs_agree(source: str, changes: set[str], fixed: bool) -> None:
    others = set(CHANCE) - {source} if fixed else set()
    program = FIX.format(module="agreeing", fixed=others, varied={source}) + "print(interventions.given)"

    found, given = map(eval, ran(program).splitlines())

    assert source in given
    if fixed:
        assert {key for key in found if found[key] != CALM[key]} == changes
    else:
        assert all(found[key] != CALM[key] for key in changes)


def test_threads_and_the_tasks_of_a_pool_begin_late_in_turn() -> None:
    found = eval(ran(FIX.format(module="agreeing", fixed=set(), varied={sources.THREADS})))

    assert found["threads"] != CALM["threads"]
    assert found["pool"] != CALM["pool"]


def test_few_bytes_of_entropy_are_others_where_they_are_changed() -> None:
    fixed, free = set(CHANCE), set(CHANCE) - {sources.ENTROPY}

    one, other = (
        eval(ran(FIX.format(module="chancy", fixed=f, varied=v)), NAMES)["secrets"]
        for f, v in ((fixed, set()), (free, {sources.ENTROPY}))
    )

    assert one != other


def test_an_uneven_clock_takes_steps_of_a_microsecond_and_of_a_third_of_a_second() -> None:
    steps = [_step(k) for k in range(1000)]

    assert min(steps) < 2_000
    assert 200_000_000 < max(steps) <= 300_000_000


def test_varied_sources_differ() -> None:
    varied = {sources.WALL, sources.named(sources.VARIABLE, "CHANCY")}

    found = eval(ran(FIX.format(module="chancy", fixed=set(), varied=varied)), NAMES)

    assert found["variable"] == "8"
    assert (found["date"] - datetime.date.today()).days in (400, 401)


@pytest.mark.parametrize(("value", "other"), [(None, "7"), ("3", "4"), ("0.5", "1.5"), ("fast", "fast_"), ("/", "/")])
def test_a_variable_is_changed_to_another_value_of_its_kind(value: str | None, other: str) -> None:
    assert changed(value) == other


FILES, FOLDERS = ("at_import", "dated", "sized", "asked"), ("listed", "scanned", "found")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files and folders at which `looking` looks."""
    made = tmp_path_factory.mktemp("looking")
    for name in FILES:
        (made / name).write_text(name)
    for name in FOLDERS:
        (made / name).mkdir()
        (made / name / "one").write_text("")
    return made


def test_only_accessed_files_and_listed_folders_are_logged(
    folder: Path,
) -> None:
    found = json.loads(ran(LOG.format(module="looking"), LOOKING=str(folder)))

    assert {file for _, file, *_ in found} == {str(HERE / "looking.py")}
    read = {source for source, *_ in found if not source.startswith(sources.VARIABLE)}
    assert read == {
        sources.WORKING,
        *(sources.named(sources.FILE, str(folder / name)) for name in FILES),
        *(sources.named(sources.FOLDER, str(folder / name)) for name in FOLDERS),
    }


def test_hidden_files_are_absent_and_the_working_folder_is_renamed(
    folder: Path,
) -> None:
    hidden = {sources.named(sources.FILE, str(folder / name)) for name in FILES[1:]}
    hidden |= {sources.named(sources.FOLDER, str(folder / name)) for name in FOLDERS} | {sources.WORKING}

    found = eval(ran(FIX.format(module="looking", fixed=set(), varied=hidden), LOOKING=str(folder)))

    assert {name: found[name] for name in ("listed", "scanned", "found", "time", "size", "there")} == {
        "listed": [],
        "scanned": [],
        "found": 0,
        "time": [],
        "size": [],
        "there": False,
    }
    assert found["here"] == found["here too"] == "/proc/self/cwd"


def test_a_file_that_is_read_at_import_is_hidden_there(folder: Path) -> None:
    hidden = {sources.named(sources.FILE, str(folder / "at_import"))}

    with pytest.raises(AssertionError, match="FileNotFoundError"):
        ran(FIX.format(module="looking", fixed=set(), varied=hidden), LOOKING=str(folder))
