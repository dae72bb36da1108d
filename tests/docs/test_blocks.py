"""Every code block of the README and of the pages in docs/ does what it says, or says why it is not run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from doc_pages import PageRun, blocks_of, indented, lines_of, parsed

REPOSITORY = Path(__file__).resolve().parents[2]
GENERATED = ("docs/api.md", "docs/operators.md", "docs/messages.md")
PAGES = sorted(str(page.relative_to(REPOSITORY)) for page in (REPOSITORY / "docs").glob("*.md"))
PAGES = ["README.md", *(page for page in PAGES if page not in GENERATED)]


@pytest.fixture(scope="module")
def faults(once: Callable[..., Path]) -> dict[str, list[str]]:
    """What is wrong with the blocks of each page."""
    pytest.importorskip("pandas", reason="the extra [notebook] is not installed")
    runner = REPOSITORY / "tests" / "support" / "doc_pages.py"
    path = os.pathsep.join([str(REPOSITORY), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore", "OMP_NUM_THREADS": "1"}

    def make(folder: Path) -> None:
        command = [sys.executable, str(runner), str(folder), *PAGES]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=110)
        assert done.returncode == 0, done.stderr

    text = (once("pages", make) / "faults.json").read_text(encoding="utf-8")
    found: dict[str, list[str]] = json.loads(text)
    return found


@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_do_as_stated(faults: dict[str, list[str]], page: str) -> None:
    assert not faults[page], "\n".join(faults[page])


def checked(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is wrong with a page of this text, in a folder that has the project's graphs."""
    monkeypatch.chdir(folder)
    (folder / "graphs").symlink_to(REPOSITORY / "graphs")
    return PageRun("page.md", text).run()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("```\nx\n```\n", "page.md:1: no language"),
        ("text\n\n    dataflow diff run.mcap\n", "page.md:3: dataflow diff run.mcap"),
        ("text\n\n    error: no such thing\n", "fence output as ```text"),
        ("```python\nprint(1)\n```\n\n```text\n2\n```\n", "page.md:5: the code above prints\n1"),
        ("```python\nx = 1\n```\n```python\ny = x + z\n```\n", "page.md:4: NameError: name 'z'"),
        ("```python\ndef test_a():\n    assert False, 'so'\n```\n", "test_a: AssertionError: so"),
        ("```yaml\ngraph: g\noperators:\n  a: {use: 'operators.cloud:Cloudbuilder'}\n```\n", "did you mean"),
        ("```yaml\nview: {panel: [world]}\n```\n", "panel"),
        ("```yaml\ncontract: c\nstream: {}\n```\n", "stream"),
        ("```sh\ndataflow fly out/a.mcap\n```\n", "page.md:2: dataflow fly out/a.mcap: ValueError: no command 'fly'"),
        ("```sh\ndataflow replay run.mcap --rate fast\n```\n", "fast"),
        ("```sh\ndataflow verify elsewhere.mcap\n```\n", "where is elsewhere.mcap?"),
        ("```sh\npip install -e '.[every]'\n```\n", "no extra every"),
        ("```sh\ndataflow run graphs/synthetic_rgbd.yaml --set frame=3\n```\n", "did you mean 'frames'"),
        ("```sh\nfly away\n```\n", "'fly' is none of"),
        ("```json\n{a: 1}\n```\n", "JSONDecodeError"),
        ("<!-- run by tests/docs/test_site.py -->\n```python\nx\n```\n", "runs nothing of this page"),
    ],
)
def test_a_block_that_does_not_is_found(text: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fault in "\n".join(checked(text, tmp_path, monkeypatch))


@pytest.mark.parametrize(
    "text",
    [
        "```python\nprint(1)\n```\n\n```text\n1\n```\n",
        "```python\nprint(1)\n```\n\nAs said elsewhere:\n\n```text\n2\n```\n",
        "<!-- not run: it needs a robot -->\n```python\nrobot.move()\n```\n",
        "```sh\ndataflow run graph.yaml --record out/a.mcap   # so\ndataflow info out/a.mcap && pytest\n```\n",
        "```yaml\ncloud: {use: operators.sources:RecordedImu, live: {deadline: 1s}}\n```\n",
    ],
)
def test_a_block_that_does_is_let_pass(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert checked(text, tmp_path, monkeypatch) == []


def test_blocks_are_read_with_line_language_mark_and_file() -> None:
    first, second = blocks_of("<!-- not run: why -->\n```sh\na\n```\n\n```python\n# file: b.py\n```\n")
    assert (first.line, first.language, first.text, first.mark) == (2, "sh", "a\n", "<!-- not run: why -->")
    assert (second.line, second.file, second.below, second.mark) == (6, "b.py", True, "")


def test_continued_list_is_no_indented_code() -> None:
    (block,) = indented("- one\n    two\n\ntext\n\n    rerun a\n    rerun b\n\nmore\n")
    assert (block.line, block.text) == (5, "rerun a\nrerun b\n")


def test_continued_lines_and_joined_commands_are_taken_apart() -> None:
    assert list(lines_of("a \\\n b && c  # d\n\ne\n")) == [(1, ["a", "b"]), (1, ["c"]), (4, ["e"])]


def test_commands_of_other_packages_are_known() -> None:
    assert parsed(["train", "detector", "DATA", "--out", "out/a.onnx"]).words[:2] == ("train", "detector")
