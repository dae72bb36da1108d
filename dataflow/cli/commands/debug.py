"""`dataflow debug`: to any recorded call of an operator, and into it. `dataflow capture`: a wrong one as a test."""

from __future__ import annotations

import re
import shlex
import sys
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from dataflow.cli.support.arguments import Json, RecordingFile, existing_recording, number, output_file, span
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, fail, out, plural, print_json, size
from dataflow.cli.support.repeated_calls import CodeOptions
from dataflow.cli.support.run_options import MakeEffects

EDITOR_COMES = 3600.0
"""Seconds that --dap waits for an editor."""

if TYPE_CHECKING:
    from dataflow.cli.support.debug_shell import Shell
    from dataflow.debugging.debugger import Debugger
    from dataflow.graph import Graph
    from dataflow.view import ViewerSink


@dataclass(frozen=True, slots=True, kw_only=True)
class DebugOptions:
    """The options of `dataflow debug`, in the order of its help."""

    do: Annotated[
        list[str] | None,
        option("--do COMMAND", "Do this and end, without a prompt. May be given several times."),
    ] = None
    code: CodeOptions
    make_effects: MakeEffects = False
    view: Annotated[
        str | None,
        option(
            "--view TARGET",
            "Draw what calls were given and made: spawn, serve, rerun+http://HOST:PORT/proxy or FILE.rrd.",
        ),
    ] = None
    dap: Annotated[
        float | None,
        option(
            "--dap PORT",
            "Serve an editor's debugger there, on this machine only, in place of a prompt; 0: any free port.",
            parser=number(0, 65535, "a port"),
        ),
    ] = None
    json: Json = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureOptions:
    """The options of `dataflow capture`, in the order of its help."""

    operator: Annotated[str, option("--op OPERATOR", "The operator.")]
    firing: Annotated[
        int | None,
        option(
            "--firing N",
            "The call, as `debug` counts them: from 0, or from the end if negative. Default: the first wrong one.",
        ),
    ] = None
    predicate: Annotated[
        str,
        option(
            "--predicate EXPRESSION",
            "True of a wrong call; sees inp, out, stamp, error. Default: not as recorded, or an error.",
        ),
    ] = ""
    to: Annotated[Path | None, option("--to TEST.py", "The file to write. Default: test_OPERATOR_N.py here.")] = None
    overwrite: Annotated[bool, option("--overwrite", "Replace a file that exists.")] = False
    code: CodeOptions
    json: Json = False


def debug(
    recording: RecordingFile,
    operator: Annotated[
        str, argument("OPERATOR[@SECONDS]", "The operator, and when to begin: at its last call by then.")
    ],
    options: DebugOptions,
) -> None:
    """Go to any recorded call of an operator: what it was given, what it made, its state before and after.

    The operator runs here, fed from the recording, call by call, forwards and back. Each call is compared with what was
    recorded. At the prompt, or by --do:

      goto N, goto @SECONDS, next, back   to a call
      until EXPRESSION                    to the next one for which Python finds it true
      diff                                to the first one that does not give what was recorded
      inputs, outputs, state, print E     look at it
      again                               make it once more, with the source as it was edited since
      step                                make it once more under pdb

    Exit code 0; 1: a --do, or a line of standard input, could not be done, or not of all calls; 2: it could not begin.

    Examples:

      dataflow debug run.mcap odometry
      dataflow debug run.mcap odometry@12.3
      dataflow debug run.mcap odometry --do diff --do state
      dataflow debug run.mcap tracker --do "until len(out.tracks.ids) > 3"
      dataflow debug run.mcap tracker@12.3 --dap 4711
    """
    recording = existing_recording(recording)
    if options.dap is not None and (options.do or options.json or options.view):
        raise fail("--dap serves an editor: --do, --json and --view are for the prompt")
    loaded = options.code.begin_again(recording, operator.partition("@")[0])
    _debug(recording, operator, loaded, options)


def capture(recording: RecordingFile, options: CaptureOptions) -> None:
    """Capture a wrong call as a test: the smallest inputs that still show it, without the recording.

    Writes a pytest file and a data file beside it. The test fails until the operator is mended. Wrong is a call that
    does not give what was recorded, that raises an error, or of which --predicate is true. Calls before it are kept as
    far as they are needed.

    The calls are made again some times, in new processes too: what does not repeat would be a test that passes by
    chance, and is refused (verify --why finds the cause).

    Exit code 0; 2: nothing is wrong, or it does not show apart from the recording, or does not repeat.

    Examples:

      dataflow capture run.mcap --op tracker
      dataflow capture run.mcap --op tracker --firing 412 --to test_lost_track.py
      dataflow capture run.mcap --op detector --predicate "out.detections is None"
    """
    recording = existing_recording(recording)
    _capture(recording, options.code.begin_again(recording, options.operator), options)


def _capture(recording: Path, graph: Graph | None, options: CaptureOptions) -> None:
    from dataflow.capture.capture import LARGE, write_test
    from dataflow.capture.capture import capture as captured
    from dataflow.debugging.debugger import Debugger
    from dataflow.recording import Recording

    began = time.monotonic()
    with Recording(recording) as opened:
        debugger = Debugger(opened, options.operator, graph)
        try:
            with redirect_stdout(sys.stderr):  # what operators print
                found = captured(opened, debugger, options.firing, options.predicate)
        except SyntaxError as error:
            raise fail(f"--predicate {options.predicate}: no Python expression: {error.msg}") from None
        finally:
            debugger.close()
    name = re.sub(r"\W", "_", found.captured.setting.name)
    path = options.to or Path(f"test_{name}_{found.number}.py")
    output_file(path, ".py", overwrite=options.overwrite, option="--to")
    words = ["dataflow", "capture", recording.name, "--op", options.operator, "--firing", str(found.number)]
    words += [*options.code.words, *(["--predicate", options.predicate] if options.predicate else ())]
    nbytes = write_test(found, path, recording.name, shlex.join(words))
    if options.json:
        told = {"test": str(path), "call": found.number, "calls": found.calls, "kept": found.left, "bytes": nbytes}
        print_json(told | {"wrong": found.wrong, "begins": found.begins, "seconds": time.monotonic() - began})
        return
    out.print(Text(f"call {found.number} of {debugger.node.name}: {found.wrong}"), soft_wrap=True)
    out.print(Text(f"{plural(found.left, 'call')} of {found.calls} kept, begun with {found.begins}"), soft_wrap=True)
    beside = f"{path.with_suffix('.capture').name} ({size(nbytes)})"
    out.print(Text(f"wrote {path} and {beside}: pytest {path}"), soft_wrap=True)
    if nbytes > LARGE:
        out.print(Text(f"its inputs are large: more than {size(LARGE)}", style="yellow"))


def _debug(recording: Path, operator: str, graph: Graph | None, options: DebugOptions) -> None:
    from dataflow.cli.support.debug_shell import Shell
    from dataflow.debugging.debugger import Debugger
    from dataflow.recording import Recording

    name, _, when = operator.partition("@")
    with Recording(recording) as opened:
        debugger = Debugger(opened, name, graph, make_effects=options.make_effects)
        begin, _ = span(opened, opened.streams) or (0, 0)
        viewer = None if options.view is None else _viewer(debugger, options.view)
        shell = Shell(debugger, begin, json=options.json, viewer=viewer)
        try:
            first = shell.number(f"@{when}") if when else 0
            if options.dap is not None:
                _serve(debugger, int(options.dap), first, shell)
                return
            begun = [f"goto {first}"] if when or options.do is None else []
            _converse(shell, [*begun, *(options.do or ())], interactive=options.do is None)
        finally:
            debugger.close()
            if viewer is not None:
                viewer.close()


def _viewer(debugger: Debugger, target: str) -> ViewerSink:
    """Opens a viewer for what an operator is given and makes, hidden in the graph or not."""
    from dataflow.cli.support.drawing import open_sink
    from dataflow.view import Save, ViewerError, parse_target

    streams = [*debugger.node.taken, *debugger.node.outputs.values()]
    try:
        parsed = parse_target(target)
        viewer = open_sink(parsed, every=0 if isinstance(parsed, Save) else None)
        types = {stream: debugger.graph.message_types(stream)[0] for stream in streams}
        viewer.open(types, static=[stream for stream in streams if stream in debugger.graph.static])
    except ViewerError as error:
        raise fail(f"--view {target}: {error}") from None
    return viewer


def _serve(debugger: Debugger, port: int, first: int, shell: Shell) -> None:
    """Serves one editor, until it leaves."""
    from dataflow.debugging.dap.session import Session, listen

    try:
        listening = listen(port)
    except OSError as error:
        raise fail(f"--dap {port}: {error}") from None
    with listening:
        listening.settimeout(EDITOR_COMES)
        host, port = listening.getsockname()
        out.print(f'waits for an editor on {host}:{port} (launch.json: "debugServer": {port})', soft_wrap=True)
        out.print("every account of this machine can connect there, and run code as you", soft_wrap=True)
        try:
            connection, _ = listening.accept()
        except TimeoutError:
            raise fail(f"no editor came to port {port} within {EDITOR_COMES:.0f} s") from None
    with connection:
        Session(connection, debugger, first, shell.number).serve()


def _converse(shell: Shell, lines: list[str], *, interactive: bool) -> None:
    """Does the lines, then those of standard input if wanted. Ends the command with 1 where one could not be done."""
    failed = False
    for line in lines:
        shell.onecmd(line)
        failed = failed or shell.failed
    if interactive and sys.stdin.isatty():
        shell.converse(f"{plural(shell.calls, 'call')}; help lists the commands")
        return
    for line in sys.stdin if interactive else ():
        if shell.onecmd(line.strip()):
            break
        failed = failed or shell.failed
    if failed:
        raise typer.Exit(DIFFERENT)
