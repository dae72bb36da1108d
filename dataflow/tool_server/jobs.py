"""Calls of tools, each in its own process: so many at once, answered within seconds or by a job that goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dataflow.environments import EnvError, Environment, in_same
from dataflow.execution.threads import environment
from dataflow.text import json_text

if TYPE_CHECKING:
    from dataflow.graph import Graph
    from dataflow.recording import Recording

AT_ONCE = 2
"""Processes that answer calls."""
MOST_WAITING = 16
"""Calls that are not answered yet."""
KEPT = 64
"""Jobs whose answers can be asked for again."""
SOON = 4.5
"""Seconds after which a call is answered by its job."""
LONGEST = 1800.0
"""Seconds that a call may take."""
MOST_BYTES = 8000
"""Of an answer, in UTF-8."""
NOTE = 200
"""Bytes of it for the note that there is more."""
OF_ONE_OPERATOR = frozenset(("goto", "diff", "state", "lines", "history", "what_if", "capture", "mended"))
"""Tools, and parts of them, that make the calls of one operator, in its environment."""
PRINTED = 2000
"""Characters that are shown of what operators printed."""


class CallFailed(ValueError):
    """Raised for a call that failed; the message has what would be right."""


@dataclass(slots=True)
class Job:
    """One call: `progress` as its process gave it, `text` the whole answer. `began`: when it was asked for (s)."""

    name: str
    tool: str
    began: float
    future: Future[None] = field(default_factory=Future)
    process: subprocess.Popen[str] | None = None
    progress: str = "waits for a process"
    text: str = ""
    failed: bool = False
    cancelled: bool = False
    seconds: float = 0.0


class Jobs:
    """Makes calls. `soon`: see `SOON`."""

    def __init__(self, *, soon: float = SOON) -> None:
        self._soon = soon
        self._pool = ThreadPoolExecutor(AT_ONCE, "job")
        self._jobs: dict[str, Job] = {}
        self._lock = threading.Lock()
        self._number = 0
        self._closed = False

    def call(self, tool: str, arguments: Mapping[str, Any]) -> str:
        """Calls a tool: its answer, or that of its job if it takes longer. Raises `CallFailed`."""
        with self._lock:
            if sum(not job.future.done() for job in self._jobs.values()) >= MOST_WAITING:
                raise CallFailed(f"{MOST_WAITING} jobs are not done: wait for one, or end one by job(id, cancel=true)")
            self._number += 1
            job = Job(str(self._number), tool, time.monotonic())
            self._jobs[job.name] = job
            for name in [n for n, each in self._jobs.items() if each.future.done()][: max(0, len(self._jobs) - KEPT)]:
                del self._jobs[name]
        job.future = self._pool.submit(self._work, job, dict(arguments))
        return self._answer(job, 0)

    def job(self, name: str, offset: int = 0, *, cancel: bool = False) -> str:
        """Returns the answer of a job from a byte on, or how far it is. Raises `CallFailed`."""
        with self._lock:
            job = self._jobs.get(name)
            if job is None:
                raise CallFailed(f"no job {name!r}; there are: {', '.join(self._jobs) or 'none'}")
            if cancel and not job.future.done():
                job.cancelled = True
                _end(job.process)
        return self._answer(job, offset)

    def close(self) -> None:
        """Ends all processes."""
        with self._lock:
            self._closed = True
            for job in self._jobs.values():
                job.cancelled = True
                _end(job.process)
        self._pool.shutdown(cancel_futures=True)

    def _answer(self, job: Job, offset: int) -> str:
        wait([job.future], self._soon)
        if not job.future.done():
            state = {"job": job.name, "tool": job.tool, "seconds": round(time.monotonic() - job.began, 1)}
            return json_text(state | {"progress": job.progress, "next": f'job(id="{job.name}") gives the answer'})
        error = job.future.exception()
        text = cut(job.text if error is None else str(error), offset, job.name)
        if job.failed or error is not None:
            raise CallFailed(text)
        return text

    def _work(self, job: Job, arguments: Mapping[str, Any]) -> None:
        python, variables = place_of(job.tool, arguments)
        with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as printed:
            with self._lock:
                if job.cancelled or self._closed:
                    raise CallFailed(f"job {job.name} was cancelled")
                job.progress = "runs"
                job.process = process = subprocess.Popen(
                    [python, "-P", "-m", "dataflow.tool_server.work"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=printed,
                    text=True,
                    env=variables,
                    start_new_session=True,
                )
            timer = threading.Timer(LONGEST, _end, [process])
            timer.start()
            try:
                found = _converse(process, job.tool, arguments, lambda text: setattr(job, "progress", text))
            finally:
                timer.cancel()
                _end(process)
                process.wait()
                job.seconds = time.monotonic() - job.began
            printed.seek(max(0, printed.seek(0, os.SEEK_END) - PRINTED))
            text = printed.read().strip()
        if job.cancelled:
            raise CallFailed(f"job {job.name} was cancelled after {job.seconds:.1f} s")
        if found is None:
            late = f" after {LONGEST:g} s, the longest that a call may take" if job.seconds >= LONGEST else ""
            raise CallFailed(f"the process of {job.tool} ended without an answer{late} ({process.returncode}): {text}")
        job.failed = "error" in found
        job.text = found["error"] if job.failed else json_text(found["answer"])
        if text and not job.failed:
            job.text += f"\nprinted: {text}"


def cut(text: str, offset: int, job: str) -> str:
    """Returns the part of an answer from a byte on that fits, with how to ask for the rest."""
    data = text.encode()
    if not 0 <= offset <= len(data):
        raise CallFailed(f"offset={offset}: the answer of job {job} has {len(data)} bytes")
    if len(data) - offset <= MOST_BYTES:
        return data[offset:].decode(errors="ignore")
    end = offset + MOST_BYTES - NOTE
    while data[end] & 0xC0 == 0x80:  # inside a character
        end -= 1
    rest = f'\n(bytes {offset} to {end} of {len(data)}: job(id="{job}", offset={end}) gives the rest)'
    return data[offset:end].decode(errors="ignore") + rest


def place_of(tool: str, arguments: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """Returns the interpreter and the variables of the process of a call: those of the operators of its recording, in
    the environment of the operator whose calls it makes. Raises `CallFailed`."""
    from dataflow.recording import Recording, RecordingError
    from dataflow.reexecution.recorded_run import ReplayError, resolved_graph

    file, env, graph = Path(arguments.get("recording", "")), None, None
    try:
        if file.is_file():
            with Recording(file) as opened:
                graph = resolved_graph(opened)
                env = None if graph is None else _env_of(tool, arguments, opened, graph)
    except RecordingError:  # the process of the call reports it
        graph = None
    except (EnvError, ReplayError) as error:
        raise CallFailed(str(error)) from None
    variables = environment(1 if graph is None else graph.threads)
    return (sys.executable, variables) if env is None else (env.python, env.variables(variables))


def _env_of(tool: str, arguments: Mapping[str, Any], recording: Recording, graph: Graph) -> Environment | None:
    from dataflow.blame.field import Field
    from dataflow.verification.places import env_of_calls, env_of_chain

    if not any(node.env for node in graph.nodes.values()):
        return None
    if tool in OF_ONE_OPERATOR:
        return env_of_calls(recording, graph, str(arguments.get("operator", "")))
    try:
        return env_of_chain(graph, Field.parse(str(arguments.get("field", ""))).stream) if tool == "blame" else None
    except EnvError:
        raise
    except ValueError:  # no field: the process of the call reports it
        return None


def answered_there(part: Callable[..., Any], arguments: Mapping[str, Any], say: Callable[[str], None]) -> Any:
    """Answers a part of a tool in the environment of its operators: in this process where it is in that.

    Raises what the part raises, as `CallFailed` from another process, and `CallFailed` without such an environment.
    """
    tool = part.__name__
    python, variables = place_of(tool, arguments)
    if in_same(variables):
        return part(**{name: value for name, value in arguments.items() if name != "path"}, say=say)
    command = [python, "-P", "-m", "dataflow.tool_server.work"]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=variables, **pipes) as process:  # it ends with the group of this one
        found = _converse(process, tool, arguments, say)
    if found is None:
        raise CallFailed(f"the process of {tool} in {python} ended without an answer ({process.returncode})")
    if "error" in found:
        raise CallFailed(found["error"])
    return found["answer"]


def _converse(
    process: subprocess.Popen[str], tool: str, arguments: Mapping[str, Any], say: Callable[[str], None]
) -> dict[str, Any] | None:
    """Returns the last line of a process; None where it ended without one."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(json.dumps({"tool": tool, "arguments": arguments}) + "\n")
        process.stdin.close()
    except BrokenPipeError:  # it has ended
        return None
    for line in process.stdout:
        found: dict[str, Any] = json.loads(line)
        if "progress" not in found:
            return found
        say(found["progress"])
    return None


def _end(process: subprocess.Popen[str] | None) -> None:
    """Ends a process with all that it started."""
    if process is not None and process.poll() is None:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:  # it ended meanwhile
            return
