"""Key expressions mean here what they mean to Zenoh."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.graph.keys import as_expression, canonical, intersect, key_fault, matching, may_reach, name_fault

CHUNKS = st.sampled_from(["a", "b", "ab", "ba", "*", "**", "$*", "a$*", "$*b", "a$*b", "$*a$*"])
PATTERNS = st.lists(CHUNKS, min_size=1, max_size=4).map("/".join)
# Zenoh itself panics over a part such as "a$*$*b".
ANY_PATTERNS = st.lists(CHUNKS | st.sampled_from(["$*$*", "$*a$*b$*", "@", "@a", "aa"]), min_size=1, max_size=6).map(
    "/".join
)
KEYS = st.lists(st.sampled_from(["a", "b", "ab", "aab", "ba", "@"]), min_size=1, max_size=4).map("/".join)


def brute_force(pattern: str, key: str) -> bool:
    """By the definition: `**` any number of parts, `*` one, `$*` any text inside one; never an `@` part."""

    def parts(want: list[str], have: list[str]) -> bool:
        if not want:
            return not have
        if want[0] == "**":
            return any(parts(want[1:], have[i:]) for i in range(len(have) + 1) if "@" not in have[:i])
        if not have or have[0].startswith("@"):
            return False
        expression = ".*" if want[0] == "*" else ".*".join(map(re.escape, want[0].split("$*")))
        return re.fullmatch(expression, have[0]) is not None and parts(want[1:], have[1:])

    return parts(pattern.split("/"), key.split("/"))


@settings(max_examples=400, deadline=None)
@given(PATTERNS, st.lists(KEYS, unique=True, max_size=6))
def test_matching_is_by_definition_of_the_wildcards(pattern: str, keys: list[str]) -> None:
    assert key_fault(pattern) is None
    assert matching(canonical(pattern), keys) == sorted(key for key in keys if brute_force(pattern, key))


@settings(max_examples=800, deadline=None)
@given(ANY_PATTERNS, ANY_PATTERNS)
def test_intersection_and_canonical_form_are_those_of_zenoh(one: str, other: str) -> None:
    theirs = [zenoh.KeyExpr.autocanonize(key) for key in (one, other)]
    assert [canonical(one), canonical(other)] == [str(key) for key in theirs]
    assert intersect(canonical(one), canonical(other)) == theirs[0].intersects(theirs[1])
    assert may_reach(canonical(one), "a/b") == theirs[0].intersects(zenoh.KeyExpr("a/b/**"))


def test_a_graph_loads_without_the_network_library() -> None:
    graph = (
        "graph: g\nrecord: {topics: ['*/image']}\noperators: {camera: {use: graph_operators:Camera}}\n"
        "network: {listen: ['tcp/127.0.0.1:7447']}\n"
    )
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from dataflow.graph import load_text; "
        f"load_text({graph!r}); assert 'zenoh' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@settings(max_examples=150, deadline=None)
@given(st.text(alphabet="ab*$/@#? ", min_size=0, max_size=8))
def test_an_expression_without_fault_is_one_to_zenoh(text: str) -> None:
    if key_fault(text) is None:
        zenoh.KeyExpr.autocanonize(text)
    elif not (set(text) & {"@", " "}):  # refused by us for reasons of our own
        try:
            zenoh.KeyExpr.autocanonize(text)
        except zenoh.ZError:
            return
        raise AssertionError(f"Zenoh takes {text!r}, we say: {key_fault(text)}")


@settings(max_examples=150, deadline=None)
@given(st.text(alphabet="ab*$/", min_size=1, max_size=8))
def test_a_pattern_of_people_becomes_an_expression_and_an_expression_stays(text: str) -> None:
    if key_fault(text) is None:
        assert as_expression(text) == text
    if "$" not in text and "**" not in text and key_fault(text.replace("*", "x")) is None:
        made = as_expression(text)
        assert key_fault(made) is None
        assert intersect(canonical(made), text.replace("*", "any"))


@settings(max_examples=100, deadline=None)
@given(st.text(min_size=0, max_size=6))
def test_a_name_without_fault_is_a_plain_key(text: str) -> None:
    if name_fault(text) is None:
        assert key_fault(text) is None
        assert str(zenoh.KeyExpr(text)) == text
        assert not set(text) & set("/*@$?#. \t\n")
