"""Reads the declaration of an operator class: annotations become ports and parameters, and faults are named."""

from __future__ import annotations

import dataclasses
import inspect
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Final, TypeVar

import pydantic
from pydantic.fields import FieldInfo

from dataflow.messages.base import Message
from dataflow.ports import Batch, In, InputPort, OperatorDefinitionError, OperatorSpec, Out, OutputPort, Sampled
from dataflow.sync.stamps import parse_duration

_PORTS: tuple[type, ...] = (In, Sampled, Batch, Out)
_EVERY: Final = "__takes_every_input__"

Method = TypeVar("Method", bound=Callable[..., Any])

Fault = Callable[[str, str], OperatorDefinitionError]
"""Makes the error for (attribute, what is wrong with it)."""


class Declaration:
    """Collects what one class declares. `bases` are the classes whose own attributes are no declarations."""

    def __init__(self, cls: type, bases: tuple[type, ...], local: Mapping[str, Any]) -> None:
        self.cls, self.bases, self._local = cls, bases, dict(local)
        self.inputs: dict[str, InputPort] = {}
        self.outputs: dict[str, OutputPort] = {}
        self.parameters: dict[str, Any] = {}
        self.state: Any = None
        for name, hint in self._annotations(local).items():
            self._attribute(name, hint)
        self._refuse_untyped()

    def fault(self, attribute: str, text: str) -> OperatorDefinitionError:
        return OperatorDefinitionError(f"{self.cls.__module__}.{self.cls.__qualname__}.{attribute}: {text}")

    def spec(
        self,
        merge: bool | None,
        tolerance: str | int | None,
        every: str | int | None,
        *,
        source: bool,
        takes: Callable[[Mapping[str, InputPort], Fault], tuple[str, ...]],
    ) -> OperatorSpec:
        """Returns what was declared, checked as a whole; `takes` reads the arguments of `process()`."""
        period = None if every is None else parse_duration(every)
        window = 0 if tolerance is None else parse_duration(tolerance)
        self._check_timing(bool(merge), window, period, every)
        if source:
            self._check_source()
            taken: tuple[str, ...] = ()
        else:
            if period is None and not self._triggers():
                raise self.fault("(inputs)", 'nothing makes it fire: declare an In[...] or give every="100ms"')
            taken = takes(self.inputs, self.fault)
            self._check_returned()
        model = pydantic.create_model(
            f"{self.cls.__name__}Parameters",
            __config__=pydantic.ConfigDict(extra="forbid", frozen=True, validate_default=True),
            **self.parameters,
        )
        doc = inspect.cleandoc(self.cls.__doc__ or "")
        return OperatorSpec(
            self.cls.__name__, doc, self.inputs, self.outputs, model, bool(merge), window, period, taken, self.state
        )

    def _annotations(self, local: Mapping[str, Any]) -> dict[str, Any]:
        """The evaluated annotations of the class and those above it, the bases aside."""
        hints: dict[str, Any] = {}
        for above in reversed(self.cls.__mro__):
            if above in (*self.bases, object):
                continue
            namespace = vars(sys.modules[above.__module__]) if above.__module__ in sys.modules else {}
            nested = {name: value for name, value in vars(above).items() if isinstance(value, type)}
            try:
                hints |= {
                    name: typing._eval_type(  # type: ignore[attr-defined]
                        typing.ForwardRef(a, is_class=True) if isinstance(a, str) else a, namespace, {**local, **nested}
                    )
                    for name, a in inspect.get_annotations(above).items()
                }
            except NameError as error:
                where = f"{error}; types of ports and of the state must be known where the class is made: above it"
                raise self.fault("(annotations)", where) from None
        return hints

    def _attribute(self, name: str, hint: Any) -> None:
        """One annotated attribute: a port, a parameter, or nothing of ours."""
        origin = typing.get_origin(hint) or hint
        value = getattr(self.cls, name, None)
        if origin is ClassVar:
            return
        if name == "state" and dataclasses.is_dataclass(origin):
            self.state = origin
            return
        if origin not in _PORTS:
            if isinstance(value, (In, Sampled, Batch, Out)):
                kind = type(value).__name__
                raise self.fault(name, f"is a {kind} port and must be annotated {kind}[...]")
            if isinstance(value, FieldInfo):
                self._refuse_taken(name, "parameter")
                self.parameters[name] = (hint, value)
            return
        self._refuse_taken(name, "port")
        if value is not None and not isinstance(value, origin):
            raise self.fault(name, f"is annotated {origin.__name__}[...] but set to a {type(value).__name__}")
        port = origin() if value is None else value
        message_types = _port_types(hint)
        if not message_types:
            raise self.fault(name, f"needs a message type: {origin.__name__}[Image], or a union of message types")
        if isinstance(port, Out):
            self.outputs[name] = OutputPort(name, message_types, port.static, port.lag, port.doc)
        else:
            self.inputs[name] = _input_port(name, port, message_types)

    def _refuse_taken(self, name: str, what: str) -> None:
        """Names that the bases use are taken; `context` is an argument of `process()`, so no port's."""
        if (what == "port" and name == "context") or any(hasattr(base, name) for base in self.bases):
            raise self.fault(name, f"is a name that Operator uses; choose another for the {what}")

    def _refuse_untyped(self) -> None:
        for name in dir(self.cls):
            value = inspect.getattr_static(self.cls, name, None)
            if isinstance(value, FieldInfo) and name not in self.parameters:
                raise self.fault(name, "is a parameter without a type: write `name: int = Param(...)`")
            if isinstance(value, (In, Sampled, Batch, Out)) and name not in self.inputs and name not in self.outputs:
                raise self.fault(name, f"is a port without a type: write `{name}: {type(value).__name__}[Image]`")

    def _triggers(self) -> list[InputPort]:
        return [port for port in self.inputs.values() if port.kind == "in"]

    def _check_timing(self, merge: bool, window: int, period: int | None, every: str | int | None) -> None:
        if period is not None and period <= 0:
            raise self.fault("every", f"must be positive, got {every!r}")
        if merge and window:
            raise self.fault("tolerance", "has no meaning with merge=True: every message fires")
        triggers = self._triggers()
        many = [port.name for port in triggers if port.many]
        if many and not merge and len(triggers) > 1:
            raise self.fault(
                many[0], "many=True on one of several joined inputs: use merge=True, or one stream an input"
            )

    def _check_returned(self) -> None:
        """Refuses a `process()` or `finish()` that is annotated to return what its outputs do not take.

        That is another message, or a `TypedDict` with a key that is no port or with another message for a port.
        """
        for method in ("process", "finish"):
            hint = self._hints(vars(self.cls).get(method)).get("return")
            self._check_message(method, _messages(hint))
            for table in filter(typing.is_typeddict, _members(hint)):
                for name, value in self._hints(table).items():
                    if name not in self.outputs:
                        known = ", ".join(self.outputs) or "none"
                        raise self.fault(method, f"returns {name!r}, which is no output; outputs: {known}")
                    self._check_emits(method, self.outputs[name], _messages(value))

    def _hints(self, annotated: Any) -> dict[str, Any]:
        try:
            return typing.get_type_hints(annotated, localns=self._local)
        except (NameError, TypeError):  # inherited, and looked at there; or a type imported for type checkers alone
            return {}

    def _check_message(self, method: str, returned: Sequence[type[Message]]) -> None:
        ports = [port for port in self.outputs.values() if not port.static]
        if returned and len(ports) != 1:
            names = ", ".join(port.name for port in ports) or "none"
            raise self.fault(method, f"returns one message, but has {len(ports)} outputs ({names}): return a mapping")
        if returned:
            self._check_emits(method, ports[0], returned)

    def _check_emits(self, method: str, port: OutputPort, returned: Sequence[type[Message]]) -> None:
        for message in returned:
            if not issubclass(message, port.types):
                raise self.fault(method, f"returns {message.SCHEMA}, but {port.name} emits {port.type_text()}")

    def _check_source(self) -> None:
        if self.inputs:
            raise self.fault(next(iter(self.inputs)), "a source has no inputs; derive from Operator instead")
        if not self.outputs:
            raise self.fault("(outputs)", "a source needs at least one Out[...]")


def _members(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union; any other type alone."""
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _messages(hint: Any) -> list[type[Message]]:
    """The message types among the alternatives; any message is none."""
    return [m for m in _members(hint) if isinstance(m, type) and issubclass(m, Message) and m is not Message]


def _port_types(hint: Any) -> tuple[type[Message], ...]:
    found = [member for argument in typing.get_args(hint) for member in _members(argument)]
    return tuple(found) if all(isinstance(m, type) and issubclass(m, Message) for m in found) else ()


def _input_port(name: str, port: In[Any] | Sampled[Any] | Batch[Any], accepted: tuple[type[Message], ...]) -> InputPort:
    if isinstance(port, Sampled):
        return InputPort(name, "sampled", accepted, port.many, port.doc, port.max_age, port.required, port.before)
    if isinstance(port, Batch):
        return InputPort(name, "batch", accepted, port.many, port.doc, max_age=port.max_age, max=port.max)
    return InputPort(name, "in", accepted, port.many, port.doc)


def takes_every_input(process: Method) -> Method:
    """Marks a `process()` that takes the context, and every input of its class by name, whatever they are."""
    vars(process)[_EVERY] = True
    return process


def process_takes(process: Any, missing: bool, inputs: Mapping[str, InputPort], fault: Fault) -> tuple[str, ...]:
    """The arguments of `process()` by name, held against the inputs; `missing`: the class defines none."""
    if missing:
        raise fault("process", "is missing: define process(self, " + ", ".join(inputs) + ")")
    if getattr(process, _EVERY, False):
        return (*inputs, "context")
    parameters = list(inspect.signature(process).parameters.values())[1:]
    names = [p.name for p in parameters]
    for parameter in parameters:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise fault("process", f"must name its inputs ({', '.join(inputs)}) instead of *{parameter.name}")
        if parameter.name not in inputs and parameter.name != "context":
            raise fault("process", f"takes {parameter.name!r}, which is no input; inputs: {', '.join(inputs)}")
    left = [name for name in inputs if name not in names]
    if left:
        raise fault("process", f"does not take the input {left[0]!r}")
    return tuple(names)
