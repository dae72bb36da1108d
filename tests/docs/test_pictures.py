"""The drawn pictures of the pages are what their script draws."""

from __future__ import annotations

import importlib.util
from pathlib import Path

PAGES = ("design.md", "concepts.md", "yesterdays-drive.md")


def test_the_drawn_pictures_are_current_and_shown(repository: Path) -> None:
    script = repository / "docs" / "images" / "draw.py"
    spec = importlib.util.spec_from_file_location("draw", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    pages = [(repository / "docs" / name).read_text(encoding="utf-8") for name in PAGES]
    for name, draw in module.PICTURES.items():
        assert (script.parent / name).read_text(encoding="utf-8") == draw(), f"run {script.relative_to(repository)}"
        assert any(f"(images/{name})" in page for page in pages)
