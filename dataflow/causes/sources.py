"""The sources on which a result may depend besides inputs, parameters and state, and what to use in their place."""

from __future__ import annotations

from dataclasses import dataclass

WALL = "wall clock"
MONOTONIC = "monotonic clock"
COMPILED = "clock read by compiled code or at an import"
RANDOM = "random"
NUMPY = "numpy's generator"
UUID = "uuid"
ENTROPY = "entropy of the system"
IDENTITY = "id()"
ADDRESSES = "addresses of objects"
HASHES = "order by hash"
PROCESS = "number of the process"
THREADS = "threads"
HEAP = "uninitialised memory"
FILE = "file"
FOLDER = "folder"
WORKING = "working folder"
VARIABLE = "environment variable"
LOCALE = "locale or time zone"
MODULE = "state of a module or class"
INPUT = "input written to"


@dataclass(frozen=True, slots=True)
class Source:
    """Words for a source: `meaning` completes "its results depend on", `instead` is what would be right."""

    meaning: str
    instead: str


SOURCES = {
    WALL: Source("the time of day", "the stamp of an input, or context.stamp"),
    MONOTONIC: Source("how long something took", "context.stamp; for elapsed time self.log or a summary"),
    COMPILED: Source(
        "a clock that compiled code reads, or a library when it is loaded",
        "a call of the library that is given the time",
    ),
    RANDOM: Source("random numbers that nothing seeded", "self.rng, within setup() or process()"),
    NUMPY: Source("numbers of a numpy generator that nothing seeded", "self.rng, within setup() or process()"),
    UUID: Source("a random identifier", "self.rng.bytes(16), or a count kept in the state"),
    ENTROPY: Source("random bytes of the system", "self.rng"),
    IDENTITY: Source("the address of an object", "a count kept in the state"),
    ADDRESSES: Source(
        "where objects lie in memory: the order of a set, hash(), repr()",
        "a list or dict, sorted() by a value, a __repr__",
    ),
    HASHES: Source("the order of a set, or hash() of a text", "sorted(), a dict, or xxhash"),
    PROCESS: Source("the number of its process", "a parameter"),
    THREADS: Source("the order in which threads finish", "one thread, or results taken in the order of the tasks"),
    HEAP: Source("memory that it has not written", "np.zeros, or every element written before it is read"),
    FILE: Source("a file that is not the one of then", "self.use_file(path): its digest is recorded"),
    FOLDER: Source("the files that a folder holds", "a list of files as a parameter; sorted()"),
    WORKING: Source("the folder that it was started in", "a parameter: it is recorded"),
    VARIABLE: Source("a variable of the environment", "a parameter: it is recorded"),
    LOCALE: Source("the locale or the time zone", "an explicit encoding, format or time zone"),
    MODULE: Source("what an operator before it left in a module or class", "self, or the state"),
    INPUT: Source("an input that it has written to itself", "a copy: messages are immutable"),
}

CHANCE = (WALL, MONOTONIC, RANDOM, NUMPY, UUID, ENTROPY, IDENTITY, PROCESS, THREADS, HEAP, ADDRESSES, COMPILED)
"""Sources that may differ between two runs of the same code on the same machine."""
MOVED = (WALL, MONOTONIC, RANDOM, NUMPY, ENTROPY, IDENTITY, ADDRESSES)
"""Of these, sources that may give results by which two runs agree: what they give can be changed so that it shows."""


def kind_of(source: str) -> str:
    """Returns the kind of a source that has a name: `environment variable` of `environment variable:GAIN`."""
    return source.partition(":")[0]


def named(kind: str, name: str) -> str:
    """Returns the source of a kind with a name, such as a variable of the environment."""
    return f"{kind}:{name}"


def name_of(source: str) -> str:
    """Returns the name of a source that has one, else nothing."""
    return source.partition(":")[2]
