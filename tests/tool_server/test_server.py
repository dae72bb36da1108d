"""An agent's own client finds and calls the tools of the server's process, over its standard input and output."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

import pytest

from dataflow.cli.commands.mcp import mcp
from dataflow.tool_server.jobs import MOST_BYTES
from dataflow.tool_server.tools import TOOLS

if TYPE_CHECKING:
    pytest.importorskip("mcp", reason="needs the extra [mcp]")
    from mcp.client import Client
    from mcp.client.stdio import StdioServerParameters, stdio_client


def talk(talked: Callable[[Client], Awaitable[None]]) -> None:
    """Starts the server, and leaves it after."""

    async def within() -> None:
        words = ["-P", "-m", "dataflow.cli.start", "mcp"]
        path = os.pathsep.join(each for each in sys.path if each)
        started = StdioServerParameters(command=sys.executable, args=words, env={"PYTHONPATH": path})
        async with asyncio.timeout(100), Client(stdio_client(started)) as client:
            await talked(client)

    asyncio.run(within())


async def ask(client: Any, tool: str, **arguments: Any) -> tuple[str, bool]:
    """Returns the text of the answer, its job's if it is late, and whether it is an error."""
    result = await client.call_tool(tool, arguments)
    text = result.content[0].text
    while text.startswith('{"job": "'):
        result = await client.call_tool("job", {"id": text.split('"')[3]})
        text = result.content[0].text
    assert len(text.encode()) <= MOST_BYTES + 100
    return text, result.is_error


def test_tools_are_listed_and_answer_in_parts_whatever_operators_print(loud: tuple[str, str]) -> None:
    recording, folder = loud
    common = {"recording": recording, "operator": "loud", "path": [folder]}

    async def talked(client: Client) -> None:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert tools.keys() == TOOLS.keys() | {"job"}
        assert all(tool.description for tool in tools.values())
        for tool in ("goto", "lines", "state", "what_if", "prove"):
            kinds = {kind["type"] for kind in tools[tool].input_schema["properties"]["call"]["anyOf"]}
            assert kinds == {"string", "integer"}, tool
        assert tools["prove"].input_schema["required"] == ["recording", "operator", "call", "expect"]
        assert "say" not in tools["prove"].input_schema["properties"]
        assert not any(tool.input_schema["additionalProperties"] for tool in tools.values())
        text, wrong = await ask(client, "prove", **common, call=3, expect="True", may_changes="False")
        assert (wrong, text) == (True, "prove takes no argument 'may_changes' (did you mean 'may_change'?)")
        text, wrong = await ask(client, "what_if", **common, call=3, set={})
        assert wrong
        assert text == "what_if takes no argument 'set' (it also takes: params, show, graph)"
        text, wrong = await ask(client, "goto", recording=recording, operator=["loud"], call=3)
        assert (wrong, text) == (True, "goto: operator=['loud']: Input should be a valid string")
        text, wrong = await ask(client, "goto", recording=recording, operator="loud")
        assert (wrong, text) == (True, "goto: call is missing")
        text, wrong = await ask(client, "goto", **common, call="3")
        assert not wrong
        assert '"number": 3' in text
        assert "written by a library" in text
        first, wrong = await ask(client, "history", **common, field="out.y.vectors[0, 0]")
        assert not wrong
        assert "gives the rest)" in first
        offset = int(first.rpartition("offset=")[2].partition(")")[0])
        rest, _ = await ask(client, "job", id=2, offset=offset)
        assert '"next": "history with first=200 goes on"' in rest
        text, wrong = await ask(client, "goto", **common, call="301")
        assert wrong
        assert "loud has calls 0 to 300, there is no 301" in text
        text, wrong = await ask(client, "goto", **common, call=3)
        assert not wrong
        assert '"number": 3' in text

    talk(talked)


def test_the_help_of_the_command_names_all_tools() -> None:
    words = (mcp.__doc__ or "").replace(",", " ").replace(";", " ").split()
    assert {*TOOLS, "job"} - {*words} == set()
