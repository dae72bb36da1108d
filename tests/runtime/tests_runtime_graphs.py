"""Small graphs for tests of the runtime."""

from __future__ import annotations

from dataflow.graph import Graph, load_text


def chain(*operators: str, count: int = 60, ratio: int = 5) -> Graph:
    """A Counter named `left`, then operators given as YAML lines."""
    body = "\n".join(f"  {line}" for line in operators)
    return load_text(
        "graph: chain\nnamespace: test\noperators:\n"
        f"  left: {{use: runtime_operators:Counter, params: {{count: {count}, ratio: {ratio}}}}}\n{body}\n"
    )
