"""The public pages name only what exists: files, headings, commands and their options."""

from __future__ import annotations

import functools
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
    [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "benchmarks").rglob("*.md")]
)
PROGRAM = typer.main.get_command(app)


@functools.cache
def all_commands() -> dict[str, Any]:
    """The commands of the engine, and those of perception, which it finds by entry points."""
    commands = dict(PROGRAM.commands)
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for name, value in project["entry-points"]["dataflow.commands"].items():
        module, _, attribute = value.partition(":")
        commands[name] = typer.main.get_command(getattr(importlib.import_module(module), attribute))
    return commands


GLOBAL_OPTIONS = {"--help", "-h", *(option for parameter in PROGRAM.params for option in parameter.opts)}
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCED = re.compile(r"^```[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
OURS = re.compile(
    r"\b(?:graphs|recordings|benchmarks|operators|dataflow|tests|docs)/[\w./-]*\w\.(?:yaml|mcap|py|md|png)\b"
)


@functools.cache
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


@functools.cache
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


def test_every_relative_link_leads_somewhere() -> None:
    for page, target in ((each, found) for each in PAGES for found in LINK.findall(prose_of(each))):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), f"{page.name}: link to {target}"
        assert not anchor or anchor in anchors_of(linked), f"{page.name}: link to {target}: no such heading"


def test_every_quoted_command_exists_with_its_options() -> None:
    for page, words in ((each, words) for each in PAGES for words in commands_of(each)):
        if words[0] not in GLOBAL_OPTIONS:
            problem = fault_of(words)
            assert problem is None, f"{page.name}: dataflow {' '.join(words)}: {problem}"


def fault_of(words: list[str]) -> str | None:
    """What is wrong with the arguments of a `dataflow` command, as far as its parser can tell without values."""
    command, known = None, all_commands()
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


def test_every_file_of_ours_that_is_named_exists() -> None:
    for page, code in ((each, code) for each in PAGES for code in code_of(each)):
        for name in OURS.findall(code):
            assert (REPOSITORY / name).exists(), f"{page.name} names {name}"
        for module in re.findall(r"\bpython3? -m ([\w.]+)", code):
            assert importlib.util.find_spec(module), f"{page.name} names the module {module}"


def test_no_page_names_a_place_on_one_machine() -> None:
    for page in PAGES:
        found = re.search(r"(?<![\w.])/(?:home|root|Users|work|tmp)/\S*", text_of(page))
        assert found is None, f"{page.name}: {found and found[0]}"


def test_the_page_of_commands_lists_every_command() -> None:
    listed = set(re.findall(r"^\| `dataflow (\w+)", text_of(REPOSITORY / "docs" / "commands.md"), re.MULTILINE))
    assert listed == set(all_commands())


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
