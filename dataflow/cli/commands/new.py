"""`dataflow new operator`, `new graph`, `new project`, `new service`, `new agent`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from rich.text import Text

from dataflow.cli.commands.machines import Connect
from dataflow.cli.support.arguments import GraphFile, Json, find_modules_in
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import fail, out, print_json
from dataflow.cli.support.run_options import Keys, Listen, machines_of

HERE = Path()
User = Annotated[str | None, option("--user USER", "Who runs it; by default you.")]
To = Annotated[Path, option("--to --out -o DIR", "The folder to write into; made where it is missing.")]


def operator(
    name: Annotated[str, argument("NAME", "Such as NearestObstacle.")],
    kind: Annotated[
        str,
        option(
            "--kind KIND",
            "operator: fires for each message; timer: at each tick of event time; source: reads a device; "
            "program: is written in C++.",
        ),
    ] = "operator",
    to: To = HERE,
    json: Json = False,
) -> None:
    """Begin an operator: a module and its test, which passes.

    In a folder that is a package the module is put into it, and the test into the `tests` beside it.

    Examples:

      dataflow new operator NearestObstacle
      dataflow new operator Thermometer --kind source
      dataflow new operator Watchdog --kind timer --to my_robot
      dataflow new operator Edges --kind program
    """
    from dataflow.scaffold.files import KINDS, operator_files, snake

    if kind not in KINDS:
        raise fail(f"--kind {kind}: expected one of {', '.join(KINDS)}")
    chosen = next(known for known in KINDS if known == kind)
    package = _package(to)
    files = operator_files(name, chosen, package)
    tests = to.resolve().parents[package.count(".")] / "tests" if package else to
    placed = {(tests if file.name.startswith("test_") else to) / file: text for file, text in files.items()}
    module = snake(name)
    hints = (f"run its test: pytest {_shown(tests / f'test_{module}.py')}",)
    _write(placed, hints, json=json)


def graph(name: Annotated[str, argument("NAME", "Such as obstacle_watch.")], to: To = HERE, json: Json = False) -> None:
    """Begin a graph file: a synthetic camera and the clouds of what it sees. It runs as it is.

    Examples:

      dataflow new graph obstacle_watch
      dataflow new graph obstacle_watch --to graphs
    """
    from dataflow.scaffold.files import graph_files

    files = {to / file: text for file, text in graph_files(name).items()}
    _write(files, (f"run it: dataflow run {_shown(next(iter(files)))}",), json=json)


def project(
    name: Annotated[str, argument("NAME", "Such as my_robot: the folder and its package.")],
    to: To = HERE,
    json: Json = False,
) -> None:
    """Begin a project: a package with an operator, a graph, tests of both, and a pyproject.toml.

    Examples:

      dataflow new project my_robot
      dataflow new project my_robot --to ~/src
    """
    from dataflow.scaffold.files import project_files, snake

    made = project_files(name)
    folder = to.expanduser() / name
    if folder.exists() and any(folder.iterdir()):
        raise fail(f"{folder} is there already, and not empty; choose another name or folder")
    package = snake(name)
    hints = (f"run its tests and its graph: cd {_shown(folder)} && pytest && dataflow run graphs/{package}.yaml",)
    _write({folder / file: text for file, text in made.items()}, hints, json=json)


def service(
    graph: GraphFile,
    name: Annotated[str | None, option("--name NAME", "Of the service; by default that of the graph.")] = None,
    user: User = None,
    keep_disk: Annotated[str, option("--keep-disk SIZE", "Bytes of recordings that a run keeps.")] = "20GB",
    days: Annotated[int, option("--days N", "Days after which recordings are deleted.", min=1)] = 14,
    listen: Listen = None,
    keys: Keys = None,
    to: To = HERE,
    json: Json = False,
) -> None:
    """Write a systemd unit that runs a graph live from the start of the machine, in this folder and installation.

    A graph with a flight recorder keeps what that keeps; any other is recorded into out/, in files of ten minutes, the
    oldest of which are deleted beyond `--keep-disk`. The second file deletes the recordings of earlier runs. A graph
    over several machines needs `--listen` and `--keys`; `dataflow new agent` writes the unit of the others.

    Examples:

      dataflow new service robot.yaml
      dataflow new service robot.yaml --user robot --keep-disk 50GB --to deploy
      dataflow new service robot.yaml --listen tls/192.168.1.2:7447 --keys laptop
    """
    import getpass
    import sys

    from dataflow.cli.support.arguments import graph_file
    from dataflow.graph import load_graph
    from dataflow.scaffold.files import service_files

    file = graph_file(graph)
    find_modules_in(None)
    loaded = load_graph(file, live=True)
    machines_of(loaded, listen, keys, here=False, begins=False)
    away = sorted({node.machine for node in loaded.nodes.values() if node.machine is not None})
    if away and listen is None:
        raise fail(f"operators run on {', '.join(away)}: give --listen, where they join, and --keys")
    flight, folder = loaded.record.flight, Path.cwd()
    command = [str(Path(sys.executable).with_name("dataflow")), "run", str(file.resolve()), "--live", "--quiet"]
    command += [] if listen is None else ["--listen", listen]
    command += [] if keys is None else ["--keys", str(keys.resolve())]
    if flight is None:
        command += ["--record", "out/{time}.mcap", "--split-every", "10min", "--keep-disk", keep_disk]
    kept = folder / (flight.folder if flight is not None else "out")
    wanted, who = name or loaded.name, user or getpass.getuser()
    files = service_files(wanted, command, folder=folder, out=kept, user=who, days=days)
    hints = (f"check it: systemd-analyze verify {_shown(to / f'{wanted}.service')}", "install it as its head describes")
    _write({to / made: text for made, text in files.items()}, hints, json=json)


def agent(
    name: Annotated[str, argument("NAME", "This machine's name in graphs (`machine:`).")],
    connect: Connect,
    keys: Annotated[Path, option("--keys FOLDER", "This machine's keys.")],
    user: User = None,
    to: To = HERE,
    json: Json = False,
) -> None:
    """Write a systemd unit by which this machine joins runs from its start on, in this folder and installation.

    Operators run in the folder dataflow-agent below this one.

    Examples:

      dataflow new agent robot --connect tls/192.168.1.2:7447 --keys robot
    """
    import getpass
    import sys

    from dataflow.machines.keys import require_machine, settings
    from dataflow.scaffold.files import agent_files

    settings(keys, connect)
    require_machine(keys, name)
    command = [str(Path(sys.executable).with_name("dataflow")), "join", name, "--connect", connect]
    command += ["--keys", str(keys.resolve()), "--folder", str(Path("dataflow-agent").resolve())]
    files = agent_files(name, command, folder=Path.cwd(), user=user or getpass.getuser())
    unit = to / f"dataflow-{name}.service"
    hints = (f"check it: systemd-analyze verify {_shown(unit)}", "install it as its head describes")
    _write({to / made: text for made, text in files.items()}, hints, json=json)


def _package(folder: Path) -> str:
    """The import path of a folder that is a package; empty for any other."""
    resolved, parts = folder.expanduser().resolve(), list[str]()
    while (resolved / "__init__.py").is_file():
        parts.insert(0, resolved.name)
        resolved = resolved.parent
    return ".".join(parts)


def _write(files: Mapping[Path, str], hints: tuple[str, ...], *, json: bool) -> None:
    """Writes all files or none: one that is there already with another content is never replaced."""
    present = [file for file, text in files.items() if file.exists() and file.read_bytes() != text.encode()]
    if present:
        raise fail(f"{present[0]} is there already; choose another name or folder")
    for file, text in files.items():
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise fail(f"{file} cannot be written: {error.strerror}") from None
    if json:
        print_json({"files": [str(file) for file in files]})
        return
    for file in files:
        out.print(Text(f"wrote {_shown(file)}"), soft_wrap=True)
    for hint in hints:
        out.print(Text(hint, style="dim"), soft_wrap=True)


def _shown(path: Path) -> str:
    """A path as short as it can be from here."""
    resolved, here = path.resolve(), Path.cwd()
    return str(resolved.relative_to(here)) if resolved.is_relative_to(here) else str(resolved)
