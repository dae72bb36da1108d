"""Operators whose calls are made by programs, for tests."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

from dataflow.messages import Number
from dataflow.messages.base import Message
from dataflow.operator import In, Out, Param
from dataflow.program import Program


class Relay(Program):
    """Gives back what it gets, and counts it. `command` is set by the fixture that compiles it."""

    message: In[Message] = In(doc="anything")
    back: Out[Message] = Out(doc="the same")
    count: Out[Number] = Out(doc="messages before it")
    total: Out[Number] = Out(doc="messages in all")

    first: int = Param(0, doc="count of the first")
    fail: int = Param(-1, tunable=True, doc="the count at which it fails")
    crash: int = Param(-1, doc="the count at which it aborts")


class Faulty(Program):
    """A program that fails in one way."""

    command = (sys.executable, "faulty.py", "none")
    patience: ClassVar[float] = 30.0

    number: In[Number] = In(doc="anything")
    out: Out[Number] = Out(doc="the parameter")

    value: float = Param(0.5, doc="what is given back")


def faulty(fault: str, **attributes: Any) -> type[Faulty]:
    """The operator whose program fails in this way."""

    class Failing(Faulty):
        command = (sys.executable, "faulty.py", fault)

    for name, value in attributes.items():
        setattr(Failing, name, value)
    return Failing
