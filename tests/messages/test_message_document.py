"""The reference page of the message types."""

from __future__ import annotations

from pathlib import Path

from messages_page import families, markdown


def test_messages_page_matches_the_declarations(repository: Path) -> None:
    page = (repository / "docs" / "messages.md").read_text(encoding="utf-8")
    assert page == markdown(), "run: python tools/messages_page.py > docs/messages.md"


def test_the_page_has_every_type_and_field() -> None:
    page = markdown()
    for classes in families().values():
        for cls in classes:
            section = page.split(f"\n### {cls.SCHEMA}\n")[1].split("\n#")[0]
            for field in cls.FIELDS:
                assert f"| `{field.name}` |" in section
