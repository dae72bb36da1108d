"""Byte-pair encoding of text as CLIP does it, from its file of merges."""

from __future__ import annotations

import gzip
import html
import itertools
import re
import unicodedata
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.inference import ModelError

LENGTH = 77
"""Tokens of a text that CLIP takes, its begin and end among them."""

_MERGES = 49152 - 256 - 2  # of the file, which holds more
_END = "</w>"
_CONTRACTION = re.compile("'(?:s|t|re|ve|m|ll|d)", re.IGNORECASE)
_KINDS = re.compile("L+|N|O+")  # letters, a digit, others


class Tokenizer:
    """Turns text into numbers of tokens. Raises ModelError for a file that is no list of merges.

    The file is `bpe_simple_vocab_16e6.txt.gz`, which comes with CLIP, or the `merges.txt` that it is elsewhere. What
    ftfy repairs (mojibake) is not repaired here.

    Source: `SimpleTokenizer` of OpenAI's CLIP (Radford et al., 2021; MIT), after Sennrich et al., "Neural machine
    translation of rare words with subword units", 2016.
    """

    def __init__(self, file: Path) -> None:
        content = file.read_bytes()
        try:
            text = (gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content).decode()
        except (OSError, EOFError, UnicodeDecodeError) as error:
            raise ModelError(f"{file} is no list of merges of a tokenizer: {error}") from None
        merges = [tuple(line.split()) for line in text.split("\n")[1 : _MERGES + 1]]
        if not merges or any(len(pair) != 2 for pair in merges if pair):
            raise ModelError(f"{file} is no list of merges of a tokenizer: after its first line each has two symbols")
        pairs = [(pair[0], pair[1]) for pair in merges if pair]
        self._ranks = {pair: rank for rank, pair in enumerate(pairs)}
        letters = list(_LETTERS.values())
        words = [*letters, *(letter + _END for letter in letters), *map("".join, pairs)]
        self._numbers = {word: number for number, word in enumerate(words)}
        self.begin, self.end = len(words), len(words) + 1

    def __call__(self, texts: Sequence[str], length: int = LENGTH) -> NDArray[np.int64]:
        """Returns (N, length): begin, tokens, end, and 0 after it; texts that are too long are cut before the end."""
        made = np.zeros((len(texts), length), np.int64)
        for row, text in zip(made, texts, strict=True):
            tokens = [self.begin, *itertools.islice(self._tokens(text), length - 2), self.end]
            row[: len(tokens)] = tokens
        return made

    def _tokens(self, text: str) -> Iterator[int]:
        clean = unicodedata.normalize("NFC", html.unescape(html.unescape(text)))
        for word in _words(" ".join(clean.split()).lower()):
            symbols = [_LETTERS[byte] for byte in word.encode()]
            symbols[-1] += _END
            yield from (self._numbers[symbol] for symbol in self._merged(symbols))

    def _merged(self, symbols: list[str]) -> list[str]:
        """Merges neighbours, those of the lowest rank first, until no two of them are in the list."""
        while len(symbols) > 1:
            best = min(itertools.pairwise(symbols), key=lambda pair: self._ranks.get(pair, len(self._ranks)))
            if best not in self._ranks:
                break
            merged: list[str] = []
            for symbol in symbols:
                if merged and (merged[-1], symbol) == best:
                    merged[-1] += symbol
                else:
                    merged.append(symbol)
            symbols = merged
        return symbols


def _words(text: str) -> Iterator[str]:
    """Yields contractions, runs of letters, single digits, and runs of what is neither nor blank."""
    kinds = "".join(map(_kind, text))
    k = 0
    while k < len(text):
        found = _CONTRACTION.match(text, k) or _KINDS.match(kinds, k)
        if found is None:
            k += 1
            continue
        yield text[k : found.end()]
        k = found.end()


@lru_cache(maxsize=4096)
def _kind(character: str) -> str:
    major = unicodedata.category(character)[0]
    return major if major in "LN" else " " if character.isspace() else "O"


def _letters() -> dict[int, str]:
    """Returns a visible character for each byte: those of Latin-1 for themselves, others from 256 on."""
    shown = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    rest = [byte for byte in range(256) if byte not in shown]
    return {byte: chr(byte) for byte in shown} | {byte: chr(256 + k) for k, byte in enumerate(rest)}


_LETTERS = _letters()
