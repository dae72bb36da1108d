"""`dataflow mcp`: the commands that find causes, as tools of coding agents."""

from __future__ import annotations

from dataflow.cli.support.output import fail
from dataflow.extras import DISTRIBUTION


def mcp() -> None:
    """Serve the commands that find the cause of a failure as tools for coding agents, over standard input and output.

    An agent starts it by its configuration (Model Context Protocol) and ends it by closing its input. Its tools are
    verify, why, goto, diff, lines, state, history, what_if, capture, blame, drops and prove; job has what takes longer.

    Examples:

      dataflow mcp
    """
    try:
        from dataflow.tool_server.server import serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "mcp":
            raise
        raise fail(f"the package mcp (2 or later) is not here: pip install '{DISTRIBUTION}[mcp]'") from None
    serve()
