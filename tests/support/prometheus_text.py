"""Reads the text format of Prometheus, strictly: https://prometheus.io/docs/instrumenting/exposition_formats/."""

from __future__ import annotations

import re

_SAMPLE = re.compile(r'(\w+)\{((?:\w+="(?:[^"\\\n]|\\["\\n])*",?)*)\} (\S+)')
_LABEL = re.compile(r'(\w+)="((?:[^"\\]|\\.)*)"')
_ESCAPES = {r"\\": "\\", r"\"": '"', r"\n": "\n"}


def prometheus(text: str) -> dict[str, list[tuple[dict[str, str], float]]]:
    """Samples by family: each has its help and its type in front, once, and no sample comes twice."""
    assert text.endswith("\n")
    found: dict[str, list[tuple[dict[str, str], float]]] = {}
    lines = iter(text.splitlines())
    family = ""
    for line in lines:
        if line.startswith("# HELP "):
            family = line.split()[2]
            assert family not in found
            kind = next(lines).removeprefix(f"# TYPE {family} ")
            assert kind == ("counter" if family.endswith("_total") else "gauge")
            found[family] = []
            continue
        match = _SAMPLE.fullmatch(line)
        assert match is not None, line
        assert match[1] == family
        labels = {n: re.sub(r"\\.", lambda e: _ESCAPES[e[0]], v) for n, v in _LABEL.findall(match[2])}
        assert labels not in [given for given, _ in found[family]]
        found[family].append((labels, float(match[3])))
    return found
