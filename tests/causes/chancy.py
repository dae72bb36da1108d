"""A module that reads every source of chance that can be fixed, each in one line; prints what it gets."""

from __future__ import annotations

import logging
import os
import random
import secrets
import sys
import threading
import time
import uuid
from dataclasses import dataclass, field
from datetime import date, datetime
from random import random as drawn
from time import time as now
from uuid import uuid4

import numpy as np


class Thing:
    """An object like those of an operator."""


@dataclass
class Stamped:
    """An object whose `__init__` was made by `exec`."""

    made: float = field(default_factory=now)


AT_LOAD = drawn()
NUMPY_AT_LOAD = np.random.normal()


def read() -> dict[str, object]:
    order: list[int] = []
    threads = [threading.Thread(target=order.append, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    return {
        "time": time.time(),
        "bound time": now(),
        "datetime": datetime.now(),
        "datetime is itself": type(datetime.now()) is datetime,
        "date": date.today(),
        "monotonic": time.monotonic_ns(),
        "python": random.Random().random(),
        "numpy": np.random.default_rng().normal(),
        "uuid": uuid4(),
        "uuid by module": uuid.uuid1(),
        "urandom": os.urandom(5),
        "secrets": secrets.token_hex(3),
        "system": random.SystemRandom().random(),
        "id": id(order),
        "factory": Stamped().made,
        "log record": logging.makeLogRecord({}).created,
        "hash": hash(Thing()),
        "repr": repr(Thing()),
        "pid": os.getpid(),
        "empty": np.empty(3000).tobytes()[-4:],
        "at load": AT_LOAD,
        "numpy at load": NUMPY_AT_LOAD,
        "variable": os.environ.get("CHANCY"),
        "file": open(__file__).readline()[:9],
        "order": len(order),
        "waits": _wait(),
        "engine": sys.modules["dataflow"].__name__,
    }


def _wait() -> float:
    """Waits for an event that never comes, by the clock of the standard library."""
    return float(threading.Event().wait(0.01))
