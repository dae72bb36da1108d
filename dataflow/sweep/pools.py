"""Places where tasks are worked on: processes of this machine, or a Ray cluster."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from threading import Event
from typing import Any

from dataflow.graph.search import import_path
from dataflow.sweep.plan import SweepError, Task
from dataflow.sweep.work import Result, perform

AHEAD = 4
"""Tasks handed to a cluster for each of its processors, so that none waits for this process."""


def local(tasks: Sequence[Task], jobs: int, timeout: float) -> Generator[tuple[Task, Result]]:
    """Yields tasks with their results as they end, `jobs` at a time. Those running end with the iteration."""
    pool = ThreadPoolExecutor(jobs, thread_name_prefix="sweep")
    left, running, stop = iter(tasks), dict[Future[Result], Task](), Event()
    try:
        while True:
            for task in left:
                running[pool.submit(perform, task, timeout, stop)] = task
                if len(running) == jobs:
                    break
            if not running:
                return
            for over in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(over), over.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def on_ray(
    tasks: Sequence[Task], address: str, jobs: int, timeout: float, variables: Mapping[str, str]
) -> Generator[tuple[Task, Result]]:
    """Yields tasks with their results as they end on a Ray cluster; "local" begins one of `jobs` processors here.

    Recordings must be where every machine of the cluster finds them: a shared folder, or a URL. Raises `SweepError`.
    """
    import ray  # of the extra `sweep`

    here = address == "local"
    where: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False} if here else {}
    try:
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level="ERROR",
            runtime_env={"env_vars": {**variables, "PYTHONPATH": import_path()}},
            **where,
        )
    except Exception as error:  # Ray raises it bare where a node does not start
        raise SweepError(
            f"--ray {address}: {error}; 'local' begins a cluster here, 'auto' takes a running one"
        ) from error
    try:
        remote = ray.remote(num_cpus=1, max_retries=1)(perform)
        most = max(1, int(ray.cluster_resources().get("CPU", 1))) * AHEAD
        left, running = iter(tasks), dict[Any, Task]()
        while True:
            while len(running) < most and (task := next(left, None)) is not None:
                running[remote.remote(task, timeout)] = task
            if not running:
                return
            for over in ray.wait(list(running))[0]:
                task = running.pop(over)
                try:
                    yield task, ray.get(over)
                except ray.exceptions.RayError as error:
                    text = f"{type(error).__name__}: {error}"
                    yield task, Result(task.key, "killed", -1, text.splitlines()[0], ({},), 0.0, text)
    finally:
        with suppress(Exception):  # an interrupted cluster that does not answer must not hide why it was left
            ray.shutdown()
