"""The commands of this package. The module of each is imported when that command, or the help of all, is asked for."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from dataflow.cli.support.options import option
from dataflow.cli.support.output import friendly_errors
from dataflow.cli.support.values import take_plainly

MAKE = "Run, replay, verify"
LOOK = "Look at graphs, operators and recordings"
RECORDINGS = "Work with recordings and bags"
FOLLOW = "Follow a running graph"


@dataclass(frozen=True, slots=True)
class Command:
    """A function of a module beside this one, as a command."""

    home: str
    """The module and the function: "replay:replay"."""
    panel: str | None = None
    """The heading under which the help lists it."""
    name: str = ""
    """By default that of the function."""
    ignore_unknown_options: bool = False
    elsewhere: bool = False
    """It follows graphs of other machines, too: `--connect` and `--keys`."""

    @property
    def called(self) -> str:
        """The word that calls it."""
        return self.name or self.home.partition(":")[2]

    def make(self) -> Any:
        """The command as Typer's group takes it."""
        app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)
        self.add_to(app)
        return typer.main.get_command(app)

    def add_to(self, app: typer.Typer) -> None:
        """Registers the function with an application."""
        module, _, function = self.home.partition(":")
        called = _with_options(getattr(import_module(f"dataflow.cli.commands.{module}"), function), self.elsewhere)
        settings = {"ignore_unknown_options": True} if self.ignore_unknown_options else {}
        app.command(
            self.called, rich_help_panel=self.panel, help=paragraphs(called.__doc__ or ""), context_settings=settings
        )(called)


@dataclass(frozen=True, slots=True)
class RemoteGraphOptions:
    """The options that name a graph of another machine."""

    connect: Annotated[str | None, option("--connect ENDPOINT", "Follow a graph of another machine: its --listen.")] = (
        None
    )
    keys: Annotated[Path | None, option("--keys FOLDER", "Keys of tools or of a machine, for --connect.")] = None


def _with_options(called: Callable[..., None], elsewhere: bool) -> Callable[..., None]:
    """Returns a command as Typer takes it: what groups options (a dataclass) is replaced by its fields."""
    taken = [*_single(called), *(_single(RemoteGraphOptions) if elsewhere else ())]

    def command(**given: Any) -> None:
        where = _filled(RemoteGraphOptions, given) if elsewhere else RemoteGraphOptions()
        with friendly_errors(), _attached(where):
            _filled(called, given)

    functools.update_wrapper(command, called)
    del command.__wrapped__  # type: ignore[attr-defined]
    command.__signature__ = inspect.Signature(taken)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in taken}
    return command


def _attached(where: RemoteGraphOptions) -> AbstractContextManager[None]:
    if where.connect is None:
        return nullcontext()
    from dataflow.client.attach import elsewhere

    return elsewhere(where.connect, where.keys)


def _single(made: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """The parameters of a function or a group, with those of the groups among them in their places."""
    for each in inspect.signature(made, eval_str=True).parameters.values():
        if _is_group(each.annotation):
            yield from _single(each.annotation)
        else:
            yield each.replace(kind=inspect.Parameter.KEYWORD_ONLY)


def _filled(made: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Calls a function, or makes a group, from the values of single options."""
    parameters = inspect.signature(made, eval_str=True).parameters
    kinds = {name: each.annotation for name, each in parameters.items()}
    return made(**{name: _filled(kind, given) if _is_group(kind) else given[name] for name, kind in kinds.items()})


def _is_group(annotation: Any) -> bool:
    return is_dataclass(annotation)


@dataclass(frozen=True, slots=True)
class Family:
    """Commands under one word."""

    called: str
    panel: str
    help: str
    members: tuple[Command, ...]

    def make(self) -> Any:
        """The group as Typer's group takes it."""
        app = typer.Typer(
            name=self.called,
            no_args_is_help=True,
            help=paragraphs(self.help),
            add_completion=False,
            rich_markup_mode="rich",
            pretty_exceptions_enable=False,
        )
        for member in self.members:
            member.add_to(app)
        group = typer.main.get_command(app)
        group.rich_help_panel = self.panel  # type: ignore[attr-defined]
        return group


def _listed(panel: str, homes: str, *, elsewhere: bool = False) -> Iterator[Command]:
    """Commands under one heading, by their modules and functions."""
    return (Command(home, panel, elsewhere=elsewhere) for home in homes.split())


BUILT_IN: tuple[Command | Family, ...] = (
    *_listed(MAKE, "demo:demo run:run env:env machines:join replay:replay verification:verify debug:debug"),
    *_listed(MAKE, "debug:capture blame:blame blame:drops mcp:mcp sweep:sweep compare:compare"),
    *_listed(LOOK, "inspection:check inspection:show doctor:doctor doctor:devices completion:completion"),
    *_listed(LOOK, "inspection:operators inspection:messages demo:graphs recordings:info recordings:diff"),
    *_listed(LOOK, "latency:latency lint:lint"),
    *_listed(LOOK, "viewing:view foxglove:foxglove", elsewhere=True),
    *_listed(RECORDINGS, "convert:convert editing:cut"),
    Command("editing:filter_", RECORDINGS, "filter"),
    *_listed(RECORDINGS, "editing:split merging:merge merging:recover"),
    Command("following.live:list_running", FOLLOW, "list"),
    *_listed(FOLLOW, "following.live:echo following.live:hz following.top:top", elsewhere=True),
    *_listed(FOLLOW, "following.health:health following.health:metrics following.spans:spans", elsewhere=True),
    Command("following.logs:logs", FOLLOW),
    *_listed(FOLLOW, "following.pub:pub following.reload:reload following.recording:record", elsewhere=True),
    *_listed(FOLLOW, "playback:playback following.recording:trigger", elsewhere=True),
    Family(
        "new",
        MAKE,
        """Begin an operator, a graph or a project, with tests that pass.

        Examples:

          dataflow new project my_robot
          dataflow new operator NearestObstacle
          dataflow new graph obstacle_watch
        """,
        tuple(Command(f"new:{name}") for name in ("operator", "graph", "project", "service", "agent")),
    ),
    Family(
        "keys",
        MAKE,
        """Make the keys by which machines and tools know each other.

        Examples:

          dataflow keys new authority
          dataflow keys add laptop --authority authority --serves 192.168.1.2
          dataflow keys add robot --authority authority
          dataflow keys add my_tools --authority authority --tools
        """,
        (Command("machines:new"), Command("machines:add")),
    ),
    Family(
        "param",
        FOLLOW,
        """Read and change the parameters of a running graph.

        Examples:

          dataflow param list
          dataflow param set detector.score_threshold 0.5
          dataflow param dump tuned.yaml
        """,
        (
            Command(
                "following.param:set_", name="set", ignore_unknown_options=True, elsewhere=True
            ),  # so that -1 is a value
            Command("following.param:get", elsewhere=True),
            Command("following.param:list_", name="list", elsewhere=True),
            Command("following.param:dump", elsewhere=True),
            Command("following.param:load", elsewhere=True),
        ),
    ),
)


class Commands(MutableMapping[str, Any]):
    """The commands of a group by name, each of ours made when it is first looked up."""

    def __init__(self) -> None:
        self._waiting: dict[str, Command | Family] = {each.called: each for each in BUILT_IN}
        self._made: dict[str, Any] = dict.fromkeys(self._waiting)  # keeps the order

    def __getitem__(self, name: str) -> Any:
        if name in self._waiting:
            self._made[name] = made = self._waiting.pop(name).make()
            for command in (made, *getattr(made, "commands", {}).values()):
                for param in command.params:
                    take_plainly(param)
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._waiting.pop(name, None)
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]
        self._waiting.pop(name, None)

    def __contains__(self, name: object) -> bool:
        return name in self._made

    def __iter__(self) -> Iterator[str]:
        return iter(self._made)

    def __len__(self) -> int:
        return len(self._made)


def paragraphs(text: str) -> str:
    """A docstring with the lines of each paragraph joined, so that it wraps where the terminal ends; lists stay.

    Its brackets are escaped, once: they are no markup, and commands that are looked up twice come here twice.

    An empty paragraph follows the first: Typer takes the rest for a docstring and would strip the indentation of
    examples that stand alone in it.
    """
    first, *rest = (block for block in inspect.cleandoc(text).split("\n\n") if block.strip())
    blocks = (first, "", *rest) if rest else (first,)
    joined = "\n\n".join(block if block.startswith(" ") else " ".join(block.split("\n")) for block in blocks)
    return re.sub(r"(?<!\\)(?=\[[a-z#/@])", r"\\", joined)
