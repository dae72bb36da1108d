"""Hooks of the site: they bring in what the pages link to and lies outside of docs/, and make links fit.

A page is written for its place in the repository, so that it reads there as it does in the site. In the site the README
is `overview.md`, other Markdown keeps its path, notebooks become pages, and any other file that a page links to is
copied to `files/`.
"""

from __future__ import annotations

import json
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
FENCED = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)(?=[)#])")
CODE_IN_ROW = re.compile(r"`[^`\n]*\\\|[^`\n]*`")
OUTSIDE = ("benchmarks/**/*.md", "recordings/README.md", "operators/weights/README.md")
"""Pages that lie elsewhere."""


def place_of(file: str) -> str:
    """Returns where in the site a file of the repository stands."""
    if file == "README.md":
        return "overview.md"
    if file.startswith("docs/"):
        file = file.removeprefix("docs/")
        return file.removesuffix(".ipynb") + ".md" if file.endswith(".ipynb") else file
    return file if file.endswith(".md") else f"files/{file}"


def pages() -> Iterator[str]:
    """Yields the files of the repository, outside of docs/ or not Markdown, that are pages of the site."""
    yield "README.md"
    for pattern in OUTSIDE:
        yield from sorted(str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob(pattern))
    yield from sorted(str(path.relative_to(REPOSITORY)) for path in (REPOSITORY / "docs").rglob("*.ipynb"))


def figures() -> list[str]:
    """Returns where in the site the pages of benchmarks/ stand, which no `nav` has to list."""
    return [place_of(file) for file in pages() if file.startswith("benchmarks/")]


def linked(text: str, file: str) -> Iterator[str]:
    """Yields the files of the repository to which the page in `file` links."""
    for prose in FENCED.split(text)[::2]:
        for target in LINK.findall(prose):
            yield posixpath.normpath(posixpath.join(posixpath.dirname(file), target))


def fitted(text: str, file: str) -> str:
    """Returns the page in `file` with links to where things are in the site."""
    here = posixpath.dirname(place_of(file))

    def replaced(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(file), match[1]))
        return posixpath.relpath(place_of(target), here or ".")

    pieces = FENCED.split(text)
    return "".join(
        CODE_IN_ROW.sub(_unescaped, LINK.sub(replaced, piece)) if k % 2 == 0 else piece
        for k, piece in enumerate(pieces)
    )


def _unescaped(code: re.Match[str]) -> str:
    """GitHub needs a backslash before `|` in the code of a table's cell; MkDocs shows it."""
    return code[0].replace("\\|", "|")


def notebook_page(path: Path) -> str:
    """Returns a notebook's cells as Markdown."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    shown = []
    for cell in cells:
        source = "".join(cell["source"])
        shown.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
    return "\n\n".join(shown) + "\n"


def github_anchor(heading: str, separator: str = "-") -> str:
    """Returns the anchor that GitHub gives a heading, so that one link serves in both places."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", separator)


# Events of MkDocs


def on_config(config: Any) -> Any:
    config.mdx_configs.setdefault("toc", {})["slugify"] = github_anchor
    config.nav.append({"Figures": figures()})
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    outside = list(pages())
    sources = {file: (REPOSITORY / file).read_text(encoding="utf-8") for file in outside if file.endswith(".md")}
    sources |= {f"docs/{page.src_uri}": page.content_string for page in files.documentation_pages()}
    for file in outside:
        content = notebook_page(REPOSITORY / file) if file.endswith(".ipynb") else sources[file]
        files.append(File.generated(config, place_of(file), content=content))
    wanted = {target for file, text in sources.items() for target in linked(text, file)}
    for target in sorted(wanted):
        if place_of(target).startswith("files/") and (REPOSITORY / target).is_file():
            files.append(File.generated(config, place_of(target), abs_src_path=str(REPOSITORY / target)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    places = {place_of(file): file for file in pages()}
    return fitted(markdown, places.get(page.file.src_uri, f"docs/{page.file.src_uri}"))
