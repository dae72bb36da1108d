"""Operators whose calls are made by a program in another language.

    class Edges(Program):
        command = ("./edges",)

        image: In[Image] = In(doc="what the camera sees")
        edges: Out[Image] = Out(doc="where it changes")
        threshold: int = Param(40, ge=1, doc="least difference of neighbours")

The class declares ports and parameters, so that graphs are checked, joined, recorded, replayed and verified as with
any operator; `dataflow.hpp` beside this file is the other side in C++. `docs/other-languages.md` specifies the frames.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from dataflow.declare import takes_every_input
from dataflow.messages.base import Message
from dataflow.operator import Context, Operator, OperatorDefinitionError, OutputError, Outputs
from dataflow.program.child import Bytes, CallKind, Child, ProgramError
from dataflow.state import StateError
from dataflow.transport.codec import decode, encode_parts
from dataflow.transport.envelope import DecodeError, Envelope, Kind

__all__ = ["Program", "ProgramError"]

_STATE = "program"


class Program(Operator, abstract=True):
    """Runs a program for the life of the operator, and makes each call in it.

    A program that gives snapshots has its state in recordings; any other that is not `stateless` is verified from its
    beginning. It seeds its random generators itself.
    """

    command: ClassVar[Sequence[str]] = ()
    """The program and its arguments. Relative paths are looked for beside the class's file; the contents of those
    that are files are noted in recordings."""
    patience: ClassVar[float] = 60.0
    """Seconds that one call may take; then the program is killed, and the operator fails."""

    def __init__(self, **params: Any) -> None:
        """Raises `ParameterError`, and `OperatorDefinitionError` without a command or with an input of many streams."""
        super().__init__(**params)
        if isinstance(self.command, str) or not self.command:
            raise OperatorDefinitionError(f"{type(self).__name__}.command is a tuple such as ('./program', '-v')")
        many = [port.name for port in self.spec.inputs.values() if port.many]
        if many:
            raise OperatorDefinitionError(f"{type(self).__name__}.{many[0]}: a program takes no input with many=True")
        self._child: Child | None = None
        self._statics: dict[str, Message] = {}

    def setup(self) -> None:
        """Starts the program and gives it the parameters. Raises `ProgramError`."""
        folder = Path(inspect.getfile(type(self))).resolve().parent
        command = list(self.command)
        for place, word in enumerate(command):
            if (folder / word).is_file() and not Path(word).is_absolute() and (place or "/" in word):
                command[place] = str(self.use_file(folder / word, name=word))
        self._child = Child(command, folder, self.patience)
        frames = [_setting(name, value) for name, value in self.params.model_dump(mode="json").items()]
        self._statics = self._messages(self._call(CallKind.SETUP, 0, frames))

    def static_outputs(self) -> Mapping[str, Message]:
        """Returns the messages of the program's reply to its setup, by port."""
        return self._statics

    @takes_every_input
    def process(self, context: Context, **given: Any) -> Outputs:
        """Gives the firing's messages to the program; returns what it makes of them. Raises `ProgramError`."""
        frames = [
            encode_parts(Envelope(Kind.MESSAGE, name, 0, 0, message.stamp, message))
            for name, value in given.items()
            for message in (value if isinstance(value, tuple) else (value,))
            if message is not None
        ]
        return self._messages(self._call(CallKind.PROCESS, context.stamp, frames))

    def finish(self) -> Outputs:
        """Lets the program make its last messages. Raises `ProgramError`."""
        return self._messages(self._call(CallKind.FINISH, 0, ()))

    def on_reset(self, input: str) -> None:
        """Has the program begin anew. Raises `ProgramError`."""
        self._call(CallKind.RESET, 0, [[input.encode()]])

    def on_parameter(self, name: str) -> None:
        """Gives a changed parameter to the program. Raises `ProgramError`."""
        if self._child is not None:
            self._call(CallKind.PARAMETER, 0, [_setting(name, self.params.model_dump(mode="json")[name])])

    def snapshot(self) -> Mapping[str, Any] | None:
        """Returns the program's state as it packs it; None where it gives none. Raises `ProgramError`."""
        found = self._call(CallKind.SNAPSHOT, 0, ())
        return None if found is None else {_STATE: b"".join(found)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Gives the program a state that it packed. Raises `ProgramError`; `StateError` where it takes none."""
        if self._call(CallKind.RESTORE, 0, [[state[_STATE]]]) is None:
            raise StateError(f"{self.command[0]} gives snapshots but cannot restore them")

    def close(self) -> None:
        """Ends the program: it is killed where it goes on for 5 s after its input ended."""
        if self._child is not None:
            self._child.end()
            self._child = None

    def _call(self, kind: CallKind, stamp: int, frames: Sequence[Sequence[Bytes]]) -> list[bytearray] | None:
        if self._child is None:
            raise ProgramError(f"{self.command[0]} is not running: setup() starts it")
        return self._child.call(kind, stamp, frames)

    def _messages(self, frames: list[bytearray] | None) -> dict[str, Message]:
        found: dict[str, Message] = {}
        for frame in frames or ():
            try:
                envelope = decode(frame)
            except DecodeError as error:
                raise OutputError(f"{self.command[0]} replied with what is no message: {error}") from error
            if envelope.message is None or envelope.stream in found:
                raise OutputError(f"{self.command[0]} replied with no message, or two, on {envelope.stream!r}")
            found[envelope.stream] = envelope.message
        return found


def _setting(name: str, value: Any) -> list[Bytes]:
    return [f"{name}={json.dumps(value)}".encode()]
