"""The server, over standard input and output, by the package `mcp`."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Awaitable, Callable
from typing import Any

from mcp.server.mcpserver import MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from pydantic import ValidationError

from dataflow.graph.problems import did_you_mean
from dataflow.tool_server.jobs import MOST_BYTES, CallFailed, Jobs
from dataflow.tool_server.tools import TOOLS

INSTRUCTIONS = f"""\
Tools to find the cause of a failure in a recorded run of a robot's operators, which re-executes bit for bit.
Begin with verify: it names the operators that do not make what was recorded. Then why, diff, lines, goto, state,
history and blame lead to the call and the line; what_if tries a change, capture writes the test, prove checks the fix.
Recordings are files (.mcap) on this machine; graph is a graph file, path are folders in which operators' modules lie.
An answer has at most {MOST_BYTES} bytes and names how to ask for the rest. A call of more than five seconds is
answered by a job: ask for it with job(id)."""

PATH = inspect.Parameter("path", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=list[str] | None)


def serve() -> None:
    """Serves one agent, until it closes standard input."""
    jobs = Jobs()
    server = _Server("dataflow", instructions=INSTRUCTIONS)
    for tool in (*TOOLS.values(), _job):
        server.add_tool(_served(tool, jobs), structured_output=False)
    try:
        server.run("stdio")
    finally:
        jobs.close()


class _Server(MCPServer):
    """Refuses arguments that a tool does not take, which the library would drop: a proof would pass without its
    conditions."""

    async def list_tools(self) -> Any:
        """Returns the tools; their schemas allow no other arguments."""
        tools = await super().list_tools()
        for tool in tools:
            tool.input_schema |= {"additionalProperties": False}
        return tools

    async def call_tool(self, name: str, arguments: dict[str, Any], context: Any = None) -> Any:
        """Calls a tool. Raises `ToolError`, of wrong arguments with what would be right."""
        tool = _job if name == "job" else TOOLS.get(name)
        if tool is not None and (unknown := arguments.keys() - (taken := _taken(tool))):
            others = [each for each in taken if each not in arguments]
            told = (f"{each!r} ({did_you_mean(each, others, 'it also takes')})" for each in sorted(unknown))
            raise ToolError(f"{name} takes no argument {', '.join(told)}")
        try:
            return await super().call_tool(name, arguments, context)
        except ToolError as error:
            if not isinstance(error.__cause__, ValidationError):
                raise
            wrong = {str(each["loc"][0]): each for each in error.__cause__.errors()}
            told = (
                f"{each} is missing" if of["type"] == "missing" else f"{each}={arguments[each]!r}: {of['msg']}"
                for each, of in wrong.items()
            )
            raise ToolError(f"{name}: {'; '.join(told)}") from None


def _taken(tool: Callable[..., Any]) -> list[str]:
    """Returns the arguments that agents give to a tool."""
    return [each.name for each in _parameters(tool)]


def _parameters(tool: Callable[..., Any]) -> list[inspect.Parameter]:
    """The parameters that agents see: every tool but `job` also takes the folders of modules."""
    parameters = inspect.signature(tool, eval_str=True).parameters
    known = {name: each for name, each in parameters.items() if name != "say"}
    return list((known if tool is _job else {**known, "path": PATH}).values())


def _job(id: str | int, offset: int = 0, cancel: bool = False) -> Any:
    """Give the answer of a job from a byte on, or how far it is; `cancel` ends it."""


def _served(tool: Callable[..., Any], jobs: Jobs) -> Callable[..., Awaitable[str]]:
    """Returns a tool as the server calls it: by a job, with the arguments that agents give."""

    @functools.wraps(tool)
    async def call(**arguments: Any) -> str:
        try:
            if tool is _job:
                asked = functools.partial(jobs.job, str(arguments.pop("id")), **arguments)
                return await asyncio.to_thread(asked)
            return await asyncio.to_thread(jobs.call, tool.__name__, arguments)
        except CallFailed as error:
            raise ToolError(str(error)) from None

    del call.__wrapped__
    call.__name__ = tool.__name__.lstrip("_")
    call.__doc__ = inspect.cleandoc(tool.__doc__ or "")
    call.__signature__ = inspect.Signature(_parameters(tool), return_annotation=Any)  # type: ignore[attr-defined]
    return call
