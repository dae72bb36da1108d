"""The public pages name only what exists: files, headings, commands and their options."""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from dataflow.cli.main import app
from dataflow.graph import load_text

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "benchmarks").glob("*.md")]
)
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
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
        quoted = "dataflow " + " ".join(words)
        if words[0] == "--help":
            continue
        assert words[0] in COMMANDS, f"{page.name}: {quoted}: no such command"
        command = COMMANDS[words[0]]
        context = command.make_context(words[0], ["--help"], resilient_parsing=True)
        try:
            _, left, _ = command.make_parser(context).parse_args(words[1:])
        except Exception as error:  # typer has its own copy of click's errors
            pytest.fail(f"{page.name}: {quoted}: {error}")
        assert not left, f"{page.name}: {quoted}: too many arguments"


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


def test_the_readme_lists_every_command() -> None:
    listed = set(re.findall(r"^\| `dataflow (\w+)", text_of(REPOSITORY / "README.md"), re.MULTILINE))
    assert listed == set(COMMANDS)


def test_the_quick_start_is_two_marked_blocks() -> None:
    marked = re.findall(
        r"^<!-- quick start: (\w+) -->\n```sh\n(.+?)^```", text_of(REPOSITORY / "README.md"), re.S | re.M
    )
    assert [name for name, _ in marked] == ["run", "test"]
    assert "dataflow replay" in marked[0][1]
    assert "pytest" in marked[1][1]


def test_the_graph_in_the_readme_passes_the_check() -> None:
    (graph,) = re.findall(r"^```yaml\n(.+?)^```", text_of(REPOSITORY / "README.md"), re.DOTALL | re.MULTILINE)
    assert load_text(graph).nodes


def test_a_command_that_does_not_exist_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    for quoted in ("dataflow fly out/a.mcap", "dataflow replay a.mcap --sideways", "dataflow info a.mcap b.mcap"):
        page.write_text(f"Say `{quoted}`.\n", encoding="utf-8")
        with pytest.raises((AssertionError, pytest.fail.Exception), match=r"page\.md: dataflow"):
            test_every_quoted_command_exists_with_its_options(page)
