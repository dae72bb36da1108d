"""Code blocks of documentation pages, by language, and a process that runs them.

`python tests/support/doc_pages.py FOLDER PAGE...` runs each page's blocks in a folder and a process of its own, and
writes what is wrong to FOLDER/faults.json: {page: ["page.md:12: ...", ...]}.

- `python` runs in order in one namespace; a `text` block right below is what it prints. Functions named `test_...` are
  called. A block that begins with `# file: NAME` is that file, and is imported.
- `yaml` is a graph, a part of one, a fault plan or a contract, and is loaded as the program does.
- `sh` is parsed: commands of `dataflow` by its own parser; quick ones run. `json` and `toml` are parsed.
- `text` is output. Code by indentation is `sh`.

The folder has the graphs and recordings of the project, and `run.mcap`, `a.mcap` and `b.mcap`: a short recorded run.

A comment above a block says that it is otherwise: `<!-- not run: REASON -->`, or `<!-- run by tests/FILE.py -->`.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import multiprocessing
import os
import re
import shlex
import subprocess
import sys
import tomllib
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
LANGUAGES = ("python", "yaml", "sh", "json", "toml", "text", "ini", "dockerfile", "cpp")
OUTPUTS = ("output", "record", "view", "to", "complete", "out", "junit", "svg", "baseline", "write_contract", "rerun")
"""Parameters of commands that name a file which the command may write."""
QUICK = ("check", "show", "info", "operators", "graphs", "diff", "latency", "lint", "logs")
"""Commands that run, where their files are there."""
READERS_OWN = {
    *("thin.mcap", "g.yaml", "graph.yaml", "drive.bag", "DRIVE.bag", "drive.mcap", "FastestDet.onnx", "robot.yaml"),
    *("tuned.yaml",),
}
"""Names that stand for files of the reader."""
PROGRAMS = (
    *("python", "python3", "pip", "pytest", "rerun", "git", "cd", "mkdir", "export", "mkdocs", "c++", "bash"),
    "ls",
)
"""What else a line of a `sh` block may begin with."""
MARK = re.compile(r"<!-- (not run: \S.*|run by (tests/\S+\.py)) -->$")
FENCE = re.compile(r"```(\w*)")


@dataclass(frozen=True)
class Block:
    """A fenced block: `line` is that of its fence, `mark` the comment above it, `file` the name it gives itself."""

    line: int
    language: str
    text: str
    mark: str = ""
    below: bool = False
    """It stands right below the block before it."""

    @property
    def file(self) -> str:
        found = re.match(r"# file: (\S+)\n", self.text)
        return found[1] if found else ""


def blocks_of(text: str) -> list[Block]:
    """Returns the fenced blocks of a page, top to bottom."""
    found: list[Block] = []
    lines = text.splitlines()
    number, before, ended = 0, "", -2
    while number < len(lines):
        line = lines[number]
        if opening := FENCE.match(line):
            start = number
            number += 1
            while number < len(lines) and lines[number] != "```":
                number += 1
            body = "".join(one + "\n" for one in lines[start + 1 : number])
            mark = before if MARK.match(before) else ""
            gap = lines[ended + 1 : start] if ended >= 0 else ["first"]
            found.append(Block(start + 1, opening[1], body, mark, below=not any(gap)))
            before, ended = "", number
        elif line.strip():
            before = line.strip()
        number += 1
    return found


def indented(text: str) -> list[Block]:
    """Returns the blocks that are code by indentation: commands, as such blocks have no other language."""
    found: list[Block] = []
    fenced, inside, before = False, False, ""
    for number, line in enumerate(text.splitlines(), 1):
        fenced ^= line.startswith("```")
        inside = not fenced and line.startswith("    ") and (inside or not before)
        if inside and before and found:
            found[-1] = replace(found[-1], text=found[-1].text + line[4:] + "\n")
        elif inside:
            found.append(Block(number - 1, "sh", line[4:] + "\n"))
        before = line.strip()
    return found


def completed(part: str, keys: set[str]) -> str:
    """Returns a graph of which the text is a part: operators, or settings beside them."""
    others = {"camera": "operators.sources:SyntheticRgbd", "imu": "operators.sources:RecordedImu"}
    lines = [f"  {name}: {{use: '{use}'}}" for name, use in others.items() if name not in keys]
    if not keys & {"record", "view", "params", "network", "seed", "threads"}:
        lines += [f"  {line}" for line in part.splitlines()]
        part = ""
    return "\n".join(["graph: part", part, "operators:", *lines, ""])


# Commands


@dataclass(frozen=True)
class Quoted:
    """A `dataflow` command: its words, and the values that its own parser makes of them, by parameter."""

    words: tuple[str, ...]
    values: dict[str, Any]

    def files(self, *, written: bool) -> Iterator[str]:
        for name, value in self.values.items():
            for item in value if isinstance(value, (list, tuple)) else [value]:
                text = str(item) if isinstance(item, (str, Path)) else ""
                if re.search(r"\.(mcap|rrd|yaml|onnx|xml|svg|json|bag)$", text) and (name in OUTPUTS) == written:
                    yield text.rpartition("=")[2]


def lines_of(script: str) -> Iterator[tuple[int, list[str]]]:
    """The commands of a `sh` block, with the line that each begins at, counted from 1; continued lines joined."""
    whole, begun = "", 0
    for number, line in enumerate(script.splitlines(), 1):
        begun = begun or number
        whole += line.removesuffix("\\")
        if not line.endswith("\\"):
            for part in whole.split("&&"):
                if words := shlex.split(part, comments=True):
                    yield begun, words
            whole, begun = "", 0


def parsed(words: list[str]) -> Quoted:
    """Raises typer's own error for a command, an option or a value that cannot be."""
    import typer

    from dataflow.cli.main import app

    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    command: Any = typer.main.get_command(app)
    name, *rest = words
    if name in project["entry-points"]["dataflow.commands"]:
        module, _, attribute = project["entry-points"]["dataflow.commands"][name].partition(":")
        command = typer.main.get_command(getattr(__import__(module, fromlist=[attribute]), attribute))
    elif name in command.commands:
        command = command.commands[name]
    else:
        raise ValueError(f"no command {name!r}")
    while getattr(command, "commands", None):
        name, *rest = rest
        command = command.commands[name]
    context = command.make_context(name, list(rest))
    return Quoted(tuple(words), {key: value for key, value in context.params.items() if value not in (None, (), [])})


# One page


class PageRun:
    """Runs the blocks of one page in the current folder, which becomes its own."""

    def __init__(self, page: str, text: str) -> None:
        self.page, self.blocks = page, sorted(blocks_of(text) + indented(text), key=lambda block: block.line)
        self.faults: list[str] = []
        self.names: dict[str, Any] = {"__name__": "page"}
        self.made: set[str] = set()

    def run(self) -> list[str]:
        self._write_files()
        printed: str | None = None
        for block in self.blocks:
            if block.language not in LANGUAGES:
                self._fault(block, f"no language of {', '.join(LANGUAGES)}: {block.language!r}")
                continue
            if block.mark:
                self._check_mark(block)
                printed = None
                continue
            try:
                if block.language == "text":
                    if printed is not None and block.below and block.text != printed:
                        self._fault(block, f"the code above prints\n{printed}")
                    printed = None
                else:
                    printed = getattr(self, f"_run_{block.language}")(block)
            except BaseException as error:
                self._fault(block, f"{type(error).__name__}: {error}\n{_where(error)}")
        self._call_tests()
        return self.faults

    def _fault(self, block: Block, what: str, line: int = 0) -> None:
        self.faults.append(f"{self.page}:{block.line + line}: {what}")

    def _write_files(self) -> None:
        for block in self.blocks:
            if block.file:
                path = Path(block.file)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.text, encoding="utf-8")
                self.made.add(block.file)

    def _check_mark(self, block: Block) -> None:
        found = MARK.match(block.mark)
        assert found is not None
        if found[2]:
            test = REPOSITORY / found[2]
            if not test.is_file() or Path(self.page).name not in test.read_text(encoding="utf-8"):
                self._fault(block, f"{found[2]} runs nothing of this page")

    def _run_python(self, block: Block) -> str:
        shown = io.StringIO()
        with contextlib.redirect_stdout(shown):
            if block.file:
                module = __import__(block.file.removesuffix(".py").replace("/", "."))
                self.names.update({k: v for k, v in vars(module).items() if not k.startswith("__")})
            else:
                code = compile("\n" * block.line + block.text, self.page, "exec")
                exec(code, self.names)
        return shown.getvalue()

    def _call_tests(self) -> None:
        for name, test in list(self.names.items()):
            if name.startswith("test_") and callable(test):
                try:
                    test()
                except BaseException as error:
                    self.faults.append(f"{self.page}: {name}: {type(error).__name__}: {error}")

    def _run_yaml(self, block: Block) -> None:
        from dataflow.chaos.plan import load_plan
        from dataflow.graph import load_graph
        from dataflow.lint.contract import load_contract

        keys = set(re.findall(r"^(\w+):", block.text, re.MULTILINE))
        path = Path(block.file or "block.yaml")
        path.write_text(block.text, encoding="utf-8")
        if "graph" in keys:
            if "inputs" not in keys:  # else it is a part of another
                load_graph(path)
        elif "contract" in keys:
            load_contract(path)
        elif "faults" in keys:
            next(load_plan(path, load_graph("graphs/chaos/robot.yaml")))
        else:
            path.write_text(completed(block.text, keys), encoding="utf-8")
            load_graph(path)

    def _run_json(self, block: Block) -> None:
        json.loads(block.text)

    def _run_toml(self, block: Block) -> None:
        tomllib.loads(block.text)

    def _run_sh(self, block: Block) -> None:
        if block.text.startswith("#!"):
            subprocess.run(["sh", "-n"], input=block.text, text=True, check=True)
            return
        for line, words in lines_of(block.text):
            program = Path(words[0]).name
            try:
                if program == "dataflow":
                    self._command(words[1:])
                elif program not in PROGRAMS:
                    raise ValueError(f"{program!r} is none of {', '.join(PROGRAMS)}; fence output as ```text")
                else:
                    self._other(program, words[1:])
            except (Exception, SystemExit) as error:
                self._fault(block, f"{shlex.join(words)}: {type(error).__name__}: {error}", line)

    def _other(self, program: str, words: list[str]) -> None:
        if program in ("python", "python3") and words[0].endswith(".py") and not (REPOSITORY / words[0]).is_file():
            raise ValueError(f"no file {words[0]}")
        for word in words:
            if extras := re.search(r"(?:^\.|robot-dataflow)\[([\w,]+)\]$", word):
                project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
                if unknown := set(extras[1].split(",")) - set(project["optional-dependencies"]):
                    raise ValueError(f"no extra {', '.join(unknown)}")

    def _command(self, words: list[str]) -> None:
        from dataflow.graph import load_graph
        from dataflow.sweep.plan import grid

        command = parsed(words)
        here = True
        for file in command.files(written=False):
            if not Path(file).exists():
                here = False
                if file not in self.made | READERS_OWN and not file.startswith(("out/", "runs/")):
                    raise ValueError(f"where is {file}?")
        self.made.update(command.files(written=True))
        settings, graph = command.values.get("settings"), command.values.get("graph")
        if settings and graph and Path(str(graph)).exists():
            choices = grid(settings) if words[0] == "sweep" else [[setting.partition("=")[::2] for setting in settings]]
            for choice in choices:
                load_graph(str(graph), settings=[f"{name}={value}" for name, value in choice])
        if words[0] in QUICK and here and not any(file.endswith(".svg") for file in command.files(written=True)):
            _executed(words)


def _executed(words: list[str]) -> None:
    """Runs a command here; raises what it said when it did not end with 0."""
    from dataflow.cli.main import app

    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            app(words, standalone_mode=False)
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"exit code {end.code}: {said.getvalue()}") from None


def _where(error: BaseException) -> str:
    return "".join(traceback.format_exception(error)[-3:])


# All pages


def _in_a_process_of_its_own(page: str, folder: Path, answer: Any) -> None:
    where = folder / page.replace("/", "_")
    where.mkdir(parents=True)
    for name in ("graphs", "recordings", "benchmarks"):
        (where / name).symlink_to(REPOSITORY / name)
    for name in ("run.mcap", "a.mcap", "b.mcap"):
        (where / name).symlink_to(folder / "run.mcap")
    (where / "out").mkdir()
    os.chdir(where)
    sys.path[:0] = [str(where), str(REPOSITORY)]
    answer.send(PageRun(page, (REPOSITORY / page).read_text(encoding="utf-8")).run())


def main(folder: Path, pages: list[str]) -> None:
    import hypothesis

    import dataflow
    import dataflow.cli.main
    import dataflow.testing
    from dataflow.graph import load_graph

    parts = (f"scipy.{part}" for part in ("ndimage", "optimize", "spatial", "stats"))
    for name in ("operators.cloud", "operators.sources", "pandas", *parts, "rich.console"):
        importlib.import_module(name)  # once, before the pages' processes are forked
    load_graph(REPOSITORY / "graphs" / "perception.yaml")  # and its operators

    hypothesis.settings.register_profile(
        "pages", derandomize=True, deadline=None, database=None, suppress_health_check=list(hypothesis.HealthCheck)
    )
    hypothesis.settings.load_profile("pages")
    os.chdir(folder)
    small = {"frames": 4, "camera.width": 96, "camera.height": 72}
    dataflow.run(REPOSITORY / "graphs" / "synthetic_rgbd.yaml", record="run.mcap", settings=small)
    fork = multiprocessing.get_context("fork")
    faults = {}
    for page in pages:
        mine, its = fork.Pipe(duplex=False)
        process = fork.Process(target=_in_a_process_of_its_own, args=(page, folder, its))
        process.start()
        its.close()
        try:
            faults[page] = mine.recv()
        except EOFError:
            faults[page] = [f"{page}: its process died"]
        process.join()
    (folder / "faults.json").write_text(json.dumps(faults), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
