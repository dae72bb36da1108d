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
from dataflow.causes.interventions import changed
from dataflow.causes.sources import CHANCE

HERE = Path(__file__).resolve().parent
SOURCE = (HERE / "chancy.py").read_text().splitlines()
LOG = """
import json
from dataflow.causes.places import Places
from dataflow.causes.traps import Traps
traps = Traps(Places(["chancy"]))
traps.set()
import chancy
chancy.read()
traps.lift()
print(json.dumps([[source, site.file, site.line, site.call, count] for (source, site), count in traps.counts.items()]))
"""
FIX = """
from dataflow.causes.interventions import Interventions
from dataflow.causes.places import Places
interventions = Interventions(Places(["chancy"]), 1_700_000_000_000_000_000)
interventions.fix({fixed!r})
interventions.vary({varied!r})
import chancy
print(chancy.read())
"""

NAMES = {"datetime": datetime, "UUID": str}


def ran(program: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path]), "CHANCY": "7"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=100, check=False
    )
    assert not done.returncode, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def logged() -> set[tuple[str, str]]:
    """The sources that were logged, each with the text of its line."""
    found = json.loads(ran(LOG))
    assert {file for _, file, *_ in found} == {str(HERE / "chancy.py")}
    return {(source, SOURCE[line - 1].strip()) for source, _, line, _, _ in found}


@pytest.mark.parametrize(
    ("source", "line"),
    [
        (sources.WALL, '"time": time.time(),'),
        (sources.WALL, '"bound time": now(),'),
        (sources.WALL, '"datetime": datetime.now(),'),
        (sources.WALL, '"date": date.today(),'),
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


def test_what_is_fixed_is_the_same_in_every_process_and_nothing_else_is() -> None:
    fixed = FIX.format(fixed=set(CHANCE), varied=set())
    free = FIX.format(fixed=set(), varied=set())

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
    programs = FIX.format(fixed=set(CHANCE), varied=set()), FIX.format(fixed=set(CHANCE) - {free}, varied=set())

    one, other = (eval(ran(p), NAMES) for p in programs)

    assert {key for key in one if one[key] != other[key]} == changes


def test_what_is_varied_differs() -> None:
    varied = {sources.WALL, sources.named(sources.VARIABLE, "CHANCY")}

    found = eval(ran(FIX.format(fixed=set(), varied=varied)), NAMES)

    assert found["variable"] == "8"
    assert (found["date"] - datetime.date.today()).days in (400, 401)


@pytest.mark.parametrize(("value", "other"), [(None, "7"), ("3", "4"), ("0.5", "1.5"), ("fast", "fast_"), ("/", "/")])
def test_a_variable_is_changed_to_another_value_of_its_kind(value: str | None, other: str) -> None:
    assert changed(value) == other
