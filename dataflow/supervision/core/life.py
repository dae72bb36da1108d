"""The life of a process as its supervisor sees it: all states, and all transitions in one table.

    STARTING → JOINED → READY → PROBING → RUNNING → ENDED → LEAVING → CLOSED → GONE

A process is forked and told what to be (STARTING), has joined the network (JOINED), has set up its operators (READY),
sends probes until its edges are proven (PROBING), works (RUNNING), has handed in its report (ENDED), was asked to leave
(LEAVING), and has closed everything it had open (CLOSED). One that reports a failure may leave in order
(FAILED); one that breaks a rule is killed (KILLED). Whatever happens, the last thing is its death (GONE); where its
restart policy allows it, it then waits for its turn (AWAY) and starts again. Its operators share its life. A sink that
has ended goes on (RUNNING) when a process whose streams it takes is started again.

Only this table changes a state. A step that it does not hold is out of turn and changes nothing: processes are other
programs, and the news of a death may cross any message.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping
from enum import Enum


class Life(Enum):
    """A state of a process."""

    STARTING = "starting"
    JOINED = "joined"
    READY = "ready"
    PROBING = "probing"
    RUNNING = "running"
    ENDED = "ended"
    LEAVING = "leaving"
    CLOSED = "closed"
    FAILED = "failed"
    KILLED = "killed"
    GONE = "gone"
    AWAY = "away"


class Step(Enum):
    """Steps that change a state. The process takes the first ones, the supervisor the others."""

    JOIN = "join"
    GET_READY = "get ready"
    END = "end"
    CLOSE = "close"
    DIE = "die"
    PROBE = "probe"
    GO = "go"
    GO_ON = "go on"
    LEAVE = "leave"
    LEAVE_FAILED = "leave, having failed"
    KILL = "kill"
    AWAIT = "await a restart"
    RESTART = "restart"
    GIVE_UP = "give up"


_ENDS = {Step.LEAVE: Life.LEAVING, Step.LEAVE_FAILED: Life.FAILED, Step.KILL: Life.KILLED, Step.DIE: Life.GONE}

TRANSITIONS: Mapping[Life, Mapping[Step, Life]] = {
    Life.STARTING: {Step.JOIN: Life.JOINED, **_ENDS},
    Life.JOINED: {Step.GET_READY: Life.READY, **_ENDS},
    Life.READY: {Step.PROBE: Life.PROBING, **_ENDS},
    Life.PROBING: {Step.GO: Life.RUNNING, **_ENDS},
    Life.RUNNING: {Step.END: Life.ENDED, **_ENDS},
    Life.ENDED: {Step.GO_ON: Life.RUNNING, **_ENDS},
    Life.LEAVING: {Step.CLOSE: Life.CLOSED, Step.KILL: Life.KILLED, Step.DIE: Life.GONE},
    Life.FAILED: {Step.LEAVE: Life.LEAVING, Step.KILL: Life.KILLED, Step.DIE: Life.GONE},
    Life.CLOSED: {Step.KILL: Life.KILLED, Step.DIE: Life.GONE},
    Life.KILLED: {Step.DIE: Life.GONE},
    Life.GONE: {Step.AWAIT: Life.AWAY},
    Life.AWAY: {Step.RESTART: Life.STARTING, Step.GIVE_UP: Life.GONE},
}

WORKS = frozenset({Life.RUNNING, Life.ENDED})
ON_ITS_WAY = frozenset({Life.STARTING, Life.JOINED, Life.READY, Life.PROBING})
HAS_PROCESS = frozenset(Life) - {Life.GONE, Life.AWAY}
"""States in which there is a process that a message or a signal can reach."""


def after(state: Life, step: Step) -> Life | None:
    """Returns the state that a step leads to; None when the step is out of turn."""
    return TRANSITIONS[state].get(step)


def how_it_ended(code: int | None) -> str:
    """Returns the meaning of a process's exit code."""
    if code is None:
        return "ended in a way that is not known"
    if code >= 0:
        return f"exited with code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"
