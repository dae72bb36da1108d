"""The public pages name only what exists: files, headings, commands and their options."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from dataflow.cli.main import app
from dataflow.graph import load_text

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "benchmarks").glob("*.md")]
)
PROGRAM = typer.main.get_command(app)


def _plugins() -> Iterator[tuple[str, Any]]:
    """The commands of perception, which the engine finds by entry points."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for name, value in project["entry-points"]["dataflow.commands"].items():
        module, _, attribute = value.partition(":")
        yield name, typer.main.get_command(getattr(importlib.import_module(module), attribute))


COMMANDS: dict[str, Any] = {**PROGRAM.commands, **dict(_plugins())}  # type: ignore[attr-defined]
GLOBAL_OPTIONS = {"--help", "-h", *(option for parameter in PROGRAM.params for option in parameter.opts)}
FENCED = re.compile(r"^```[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
OURS = re.compile(
    r"\b(?:graphs|recordings|benchmarks|operators|dataflow|tests|docs)/[\w./-]*\w\.(?:yaml|mcap|py|md|png)\b"
)

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def prose_of(page: Path) -> str:
    """The page without its code."""
    return re.sub(r"`[^`\n]+`", "", FENCED.sub("", text_of(page)))


def code_of(page: Path) -> Iterator[str]:
    """Every line of a code block, continued lines joined, and every piece of code in the text."""
    text = text_of(page)
    for block in FENCED.findall(text):
        yield from block.replace("\\\n", " ").splitlines()
    rest = FENCED.sub("", text)
    yield from (line.strip() for line in rest.splitlines() if line.startswith("    "))
    yield from (" ".join(code.split()) for code in re.findall(r"`([^`]+)`", rest))


def anchors_of(page: Path) -> set[str]:
    """What GitHub calls the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", FENCED.sub("", text_of(page)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


def commands_of(page: Path) -> Iterator[list[str]]:
    """The arguments of every quoted `dataflow` command."""
    for code in code_of(page):
        for command in code.split("&&"):
            found = re.match(r"\s*(?:\S*/)?dataflow\s+(\S.*)", command)
            if found:
                yield shlex.split(found[1], comments=True)


@each_page
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), f"{page.name}: link to {target}"
        assert not anchor or anchor in anchors_of(linked), f"{page.name}: link to {target}: no such heading"


@each_page
def test_every_quoted_command_exists_with_its_options(page: Path) -> None:
    for words in commands_of(page):
        if words[0] not in GLOBAL_OPTIONS:
            problem = fault_of(words)
            assert problem is None, f"{page.name}: dataflow {' '.join(words)}: {problem}"


def fault_of(words: list[str]) -> str | None:
    """What is wrong with the arguments of a `dataflow` command, as far as its parser can tell without values."""
    command, known = None, COMMANDS
    name, *rest = words
    while True:
        if name not in known:
            return f"no command {name!r}"
        command = known[name]
        known = getattr(command, "commands", None)
        if known is None or not rest:
            break
        name, *rest = rest
    context = command.make_context(name, [], resilient_parsing=True)
    context.resilient_parsing = False
    try:
        _, left, _ = command.make_parser(context).parse_args(rest)
    except Exception as error:  # typer has its own copy of click's errors
        return str(error)
    return "too many arguments" if left else None


@each_page
def test_every_file_of_ours_that_is_named_exists(page: Path) -> None:
    for code in code_of(page):
        for name in OURS.findall(code):
            assert (REPOSITORY / name).exists(), f"{page.name} names {name}"
        for module in re.findall(r"\bpython3? -m ([\w.]+)", code):
            assert importlib.util.find_spec(module), f"{page.name} names the module {module}"


@each_page
def test_no_page_names_a_place_on_somebodys_machine(page: Path) -> None:
    found = re.search(r"(?<![\w.])/(?:home|root|Users|work|tmp)/\S*", text_of(page))
    assert found is None, f"{page.name}: {found and found[0]}"


def test_the_page_of_commands_lists_every_command() -> None:
    listed = set(re.findall(r"^\| `dataflow (\w+)", text_of(REPOSITORY / "docs" / "commands.md"), re.MULTILINE))
    assert listed == set(COMMANDS)


def test_the_quick_start_is_two_marked_blocks() -> None:
    marked = re.findall(
        r"^<!-- quick start: (\w+) -->\n```sh\n(.+?)^```", text_of(REPOSITORY / "README.md"), re.S | re.M
    )
    assert [name for name, _ in marked] == ["run", "test"]
    assert "dataflow replay" in marked[0][1]
    assert "pytest" in marked[1][1]


def test_the_graph_in_the_first_steps_passes_the_check() -> None:
    page = text_of(REPOSITORY / "docs" / "first-steps.md")
    (graph,) = re.findall(r"^```yaml\n(.+?)^```", page, re.DOTALL | re.MULTILINE)
    assert load_text(graph).nodes


@pytest.mark.parametrize(
    ("quoted", "fault"),
    [
        ("fly out/a.mcap", "no command 'fly'"),
        ("replay a.mcap --sideways", "sideways"),
        ("replay a.mcap --rate", "rate"),
        ("info a.mcap b.mcap", "too many arguments"),
        ("train pilot DATA", "no command 'pilot'"),
    ],
)
def test_a_command_that_cannot_be_is_found(quoted: str, fault: str) -> None:
    assert fault in (fault_of(quoted.split()) or "")
