"""A sweep from its beginning to its table."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, redirect_stdout, suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

from dataflow.graph import Graph, load_graph
from dataflow.graph.search import import_path
from dataflow.sweep.plan import Choice, Digests, SweepError, Task, What, command_of, sources_in, tasks_of
from dataflow.sweep.table import Store, summed_up, write_table
from dataflow.sweep.warm import Worker
from dataflow.sweep.work import Result, commands_of, perform

AHEAD = 4
"""Tasks handed to a cluster for each of its processors, so that none waits for this process."""
MOST_JOBS = 256


def local(
    tasks: Sequence[Task], jobs: int, timeout: float, begun: Sequence[Worker] = ()
) -> Generator[tuple[Task, Result]]:
    """Yields tasks with their results as they end, `jobs` at a time. Those running end with the iteration. `begun`: at
    most so many workers that were started before."""
    pool = ThreadPoolExecutor(jobs, thread_name_prefix="sweep")
    left, running, stop = iter(tasks), dict[Future[Result], Task](), Event()
    workers = [*begun, *(Worker(commands_of(tasks)) for _ in range(jobs - len(begun)))]
    idle = SimpleQueue[Worker]()
    for worker in workers:
        idle.put(worker)

    def work(task: Task) -> Result:
        worker = idle.get()
        try:
            return perform(task, timeout, worker, stop)
        finally:
            idle.put(worker)

    try:
        while True:
            for task in left:
                running[pool.submit(work, task)] = task
                if len(running) == jobs:
                    break
            if not running:
                return
            for over in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(over), over.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)
        for worker in workers:
            worker.close()


def on_ray(
    tasks: Sequence[Task], address: str, jobs: int, timeout: float, variables: Mapping[str, str]
) -> Generator[tuple[Task, Result]]:
    """Yields tasks with their results as they end on a Ray cluster; "local" begins one of `jobs` processors here.

    Recordings must be where every machine of the cluster finds them: a shared folder, or a URL. Raises `SweepError`.
    """
    if not tasks:  # a cluster takes seconds to begin
        return
    import ray  # of the extra `ray`

    where: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False} if address == "local" else {}
    env = {"env_vars": {**variables, "PYTHONPATH": import_path()}}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", runtime_env=env, **where)
    except Exception as error:  # Ray raises it bare where a node does not start
        raise SweepError(
            f"--ray {address}: {error}; 'local' begins a cluster here, 'auto' takes a running one"
        ) from error
    with redirect_stdout(sys.stderr):  # Ray's threads print there that a process was killed, and results go there, too
        try:
            yield from _awaited(ray, tasks, timeout)
        finally:
            with suppress(Exception):  # an interrupted cluster that does not answer must not hide why it was left
                ray.shutdown()


def _awaited(ray: Any, tasks: Sequence[Task], timeout: float) -> Generator[tuple[Task, Result]]:
    """Yields tasks with their results as they end on the cluster to which this process is connected."""
    remote = ray.remote(num_cpus=1, max_retries=1)(_there)
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


_worker: Worker | None = None
"""That of a process of a cluster, which does one task after the other."""


def _there(task: Task, timeout: float) -> Result:
    """Does a task on a machine of a cluster."""
    global _worker
    if _worker is None:
        _worker = Worker(commands_of([task]))
    return perform(task, timeout, _worker)


@dataclass(slots=True)
class Sweep:
    """Recordings by settings.

    - `recordings`: files, folders, URLs.
    - `graph`: a graph file; None: of each recording the one that made it.
    - `choices`: of settings, each as (name, value) pairs. `maps`: of bags, topics to streams.
    - `folders`: in which operators' modules are sought besides.
    - `folder`: where results are kept, the table under `name`. `again`: also run what has one.
    - `jobs`: recordings at a time; None: one for each core. `timeout`: seconds for one.
    - `ray`: address of a Ray cluster; "local" begins one.

    Raises `SweepError`, `GraphError`, `ReplayError`, `RecordingError`, `OSError` for what cannot be begun.
    """

    recordings: Sequence[str]
    what: What = "replay"
    graph: Path | None = None
    choices: Sequence[Choice] = ((),)
    maps: Sequence[str] = ()
    folders: Sequence[Path] = ()
    folder: Path = Path("out/sweep")
    jobs: int | None = None
    ray: str | None = None
    timeout: float = 3600.0
    again: bool = False
    name: str = "sweep"
    graphs: dict[Choice, Graph | None] = field(init=False)
    tasks: list[Task] = field(init=False)
    left: list[Task] = field(init=False)
    store: Store = field(init=False)
    _begun: list[Worker] = field(init=False, default_factory=list)
    """Workers that were started before it was known what is to be done."""

    def __post_init__(self) -> None:
        if self.graph is None and any(self.choices):
            raise SweepError("--set changes a graph file: name one")
        if self.jobs is not None and not 1 <= self.jobs <= MOST_JOBS:
            raise SweepError(f"--jobs {self.jobs}: expected 1 to {MOST_JOBS}")
        if not self.recordings:
            raise SweepError("no recordings: name files, folders or URLs with --recordings")
        self.store = Store(self.folder)
        try:
            self._plan()
        except BaseException:
            self._end_begun()
            raise

    def _plan(self) -> None:
        digests = Digests(self.folder / "digests.json")
        sources = sources_in(self.recordings, digests)
        if self.ray is None and (self.again or self.store.empty()):  # planning takes as long as they take to begin
            for _ in range(min(self._cores, len(sources) * len(self.choices))):
                self._begun.append(Worker((command_of(self.what),)))
                self._begun[-1].start()
        self.graphs = {
            choice: None if self.graph is None else load_graph(self.graph, settings=[f"{n}={v}" for n, v in choice])
            for choice in self.choices
        }
        named = None if self.graph is None else str(self.graph.resolve())
        folders = [folder.resolve() for folder in self.folders]
        words = [word for value in self.maps for word in ("--map", value)]
        words += [word for value in folders for word in ("--path", str(value))]
        self.tasks = tasks_of(self.what, sources, self.graphs, named, words, folders, digests)
        digests.save()
        self.left = [task for task in self.tasks if self.again or not self.store.has(task.key)]

    @property
    def _cores(self) -> int:
        return self.jobs or len(os.sched_getaffinity(0))

    def _end_begun(self) -> None:
        while self._begun:
            self._begun.pop().close()

    @property
    def table(self) -> Path:
        """The Parquet file."""
        return self.folder / f"{self.name}.parquet"

    def run(self) -> Iterator[tuple[Task, Result]]:
        """Yields what is left to do, with its result once that is kept. Writes the table however it ends."""
        where = (
            local(self.left, self._cores, self.timeout, self._begun)
            if self.ray is None
            else on_ray(self.left, self.ray, self._cores, self.timeout, self._asked())
        )
        try:
            with closing(where) as working:
                for task, result in working:
                    self.store.keep(result)
                    yield task, result
        finally:
            self._end_begun()
            write_table(self.table, self.tasks, self.store)

    def _asked(self) -> dict[str, str]:
        """Returns the variables of this process that the graphs ask for."""
        loaded = [graph for graph in self.graphs.values() if graph is not None]
        named = (graph.sources_bundle.environment.items() for graph in loaded)
        return {name: value for pairs in named for name, value in pairs if value is not None}

    def summary(self) -> list[dict[str, Any]]:
        """Returns what came of each choice of settings (`dataflow.sweep.table.summed_up`)."""
        return summed_up(self.tasks, self.store)
