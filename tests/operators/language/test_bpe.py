"""The tokenizer against what the merges say."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from operators.inference import ModelError
from operators.language.bpe import Tokenizer


@pytest.fixture
def merges(tmp_path: Path) -> Path:
    file = tmp_path / "merges.txt"
    file.write_text("#version: made\nl o\nlo w</w>\nlo w\ne r</w>\nlow er</w>\na a\n", encoding="utf-8")
    return file


def symbols(file: Path, text: str) -> list[str]:
    """The tokens of a text by their symbols, worked out from the file as its authors number them."""
    shown = [*range(33, 127), *range(161, 173), *range(174, 256)]
    letters = [chr(b) for b in shown] + [chr(256 + k) for k in range(256 - len(shown))]
    pairs = [line.split() for line in file.read_text(encoding="utf-8").splitlines()[1:]]
    names = [*letters, *(f"{each}</w>" for each in letters), *map("".join, pairs), "<begin>", "<end>"]
    tokens = Tokenizer(file)([text])[0].tolist()
    end = tokens.index(len(names) - 1)
    assert tokens[0] == len(names) - 2
    assert not any(tokens[end + 1 :])
    return [names[number] for number in tokens[1:end]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("low", ["low</w>"]),
        ("  LOWER\tlow ", ["lower</w>", "low</w>"]),
        ("slow", ["s", "low</w>"]),
        ("aaaa", ["aa", "a", "a</w>"]),  # the last a ends the word and is another symbol
        ("low's", ["low</w>", "'", "s</w>"]),  # a contraction is a word
        ("don't!?", ["d", "o", "n</w>", "'", "t</w>", "!", "?</w>"]),
        ("a1 23", ["a</w>", "1</w>", "2</w>", "3</w>"]),  # each digit is a word
        ("é", ["Ã", "©</w>"]),  # its two bytes
        ("e\u0301", ["Ã", "©</w>"]),  # the same, decomposed
        ("&amp;lt;", ["<</w>"]),
        ("", []),
    ],
)
def test_words_are_merged_by_rank(merges: Path, text: str, expected: list[str]) -> None:
    assert symbols(merges, text) == expected


def test_a_long_text_is_cut_before_its_end(merges: Path) -> None:
    tokenizer = Tokenizer(merges)
    made = tokenizer(["low " * 200, "low"])
    assert made.shape == (2, 77)
    assert made[0, -1] == tokenizer.end
    assert (made[0, 1:-1] == made[1, 1]).all()
    assert tokenizer(["low low low"], 4).tolist() == [[tokenizer.begin, made[1, 1], made[1, 1], tokenizer.end]]


def test_a_compressed_file_is_read_and_another_refused(merges: Path, tmp_path: Path) -> None:
    packed = tmp_path / "merges.txt.gz"
    packed.write_bytes(gzip.compress(merges.read_bytes()))
    assert Tokenizer(packed)(["lower"]).tolist() == Tokenizer(merges)(["lower"]).tolist()
    for content in (packed.read_bytes()[:30], b"#version\nthree symbols here\n", b"\xff\xfe\x00"):
        (tmp_path / "other").write_bytes(content)
        with pytest.raises(ModelError, match="other is no list of merges of a tokenizer"):
            Tokenizer(tmp_path / "other")
