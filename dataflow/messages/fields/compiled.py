"""Functions made for one message class: its constructor, the decoder's way in, its digest, its fields in order.

They say the same as the general ones in `dataflow.messages.base`, without a loop over the declared fields: as in
`dataclasses`, source text is written for the class and compiled. They handle values that are in canonical form or one
copy away from it, and hand everything else, faults included, to the general functions. A field's name occurs in that
text as an identifier and as a dictionary key; whatever else belongs to a class is referred to, never written out. The
text's own names begin with an underscore, which no field's does.
"""

from __future__ import annotations

import keyword
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dataflow.messages.fields.compiled_digest import content_text, digest_text, value_text
from dataflow.messages.fields.declared import (
    INT64_MAX,
    INT64_MIN,
    MISSING,
    ArrayField,
    Field,
    ScalarField,
    canonical_stamp,
    scalar_value,
)
from dataflow.messages.fields.memory import LARGE, copied

_FROZEN, _FROZEN_IS = 0x401, 0x001
"""Of numpy's array flags C-contiguous and writeable, and what they are in a frozen array."""


@dataclass(frozen=True, slots=True)
class Compiled:
    """The functions of one class.

    `construct` takes the message, the stamp and the fields by keyword; it is None where a name is no plain identifier.
    `adopt` takes the message, the stamp, and its scalars and arrays in order; it returns False where it leaves that to
    the general way.
    """

    construct: Callable[..., None] | None
    adopt: Callable[[Any, int, Any, Any], bool]
    digest: Callable[[Any], bytes]
    header: Callable[[Any], tuple[Any, ...]]
    arrays: Callable[[Any], tuple[Any, ...]]
    content: Callable[[Any], tuple[Any, tuple[Any, ...]]]
    """Returns (schema, scalars, (dtype, shape) of each array), and the arrays."""
    dtypes: tuple[Mapping[str, np.dtype[Any]], ...]
    """Of each array field the dtypes by their numpy names, such as `<f4`."""


def compile_class(
    cls: type,
    schema: str,
    scalars: tuple[ScalarField, ...],
    arrays: tuple[ArrayField, ...],
    general: Callable[..., None],
    *,
    validates: bool,
) -> Compiled:
    """Makes the functions of a class. `general` constructs a message from whatever is given, or raises."""
    fields: tuple[Field, ...] = (*scalars, *arrays)
    names: dict[str, Any] = {
        "_bool": bool,
        "_cls": cls,
        "_copied": copied,
        "_float": float,
        "_frozen": _FROZEN,
        "_frozen_is": _FROZEN_IS,
        "_general": general,
        "_int": int,
        "_large": LARGE,
        "_max": INT64_MAX,
        "_min": INT64_MIN,
        "_missing": MISSING,
        "_ndarray": np.ndarray,
        "_scalar": scalar_value,
        "_schema": schema,
        "_stamp": canonical_stamp,
        "_str": str,
        "_tuple": tuple,
    }
    plain = all(f.name.isascii() and f.name.isidentifier() and not keyword.iskeyword(f.name) for f in fields)
    names["_construct"] = None
    text = [
        *(_construct(names, scalars, arrays, validates) if plain else []),
        *_adopt(names, scalars, arrays, validates),
        *digest_text(names, schema, scalars, arrays),
        "def _header(_self):",
        "    _state = _self.__dict__",
        f"    return ({''.join(f'{value_text(f)}, ' for f in scalars)})",
        "def _arrays(_self):",
        "    _state = _self.__dict__",
        f"    return ({''.join(f'_state[{f.name!r}], ' for f in arrays)})",
        *content_text(names, scalars, arrays),
    ]
    exec(compile("\n".join(text), f"<message {schema!r}>", "exec"), names)
    construct, adopt, digest, header, held, content = (
        names[f"_{n}"] for n in ("construct", "adopt", "digest", "header", "arrays", "content")
    )
    dtypes = tuple({d.str: np.dtype(d.str) for d in f.dtypes} for f in arrays)
    return Compiled(construct, adopt, digest, header, held, content, dtypes)


def _construct(
    names: dict[str, Any], scalars: tuple[ScalarField, ...], arrays: tuple[ArrayField, ...], validates: bool
) -> list[str]:
    taken = []
    for k, spec in enumerate(scalars):
        names[f"_default{k}"] = MISSING if spec.required else None if spec.default is MISSING else spec.default
        taken.append(f"{spec.name}=_default{k}, ")
    taken += [f"{f.name}=None, " for f in arrays]
    fields: tuple[Field, ...] = (*scalars, *arrays)
    passed = "".join(f", {f.name}={f.name}" for f in fields)
    text = [
        f"def _construct(_self, *, stamp=_missing, {''.join(taken)}**_unknown):",
        "    if _self.__class__ is not _cls or _unknown:",
        f"        return _general(_self, stamp=stamp{passed}, **_unknown)",
    ]
    if arrays:
        text += [
            f"    if not ({_fit(names, arrays, [f.name for f in arrays])}):",
            f"        return _general(_self, stamp=stamp{passed})",
        ]
    text += [
        "    _state = _self.__dict__",
        "    if stamp.__class__ is _int and _min < stamp < _max:",
        "        _state['stamp'] = stamp",
        "    elif stamp is not _missing:",
        "        _state['stamp'] = _stamp(_schema, stamp)",
    ]
    for k, spec in enumerate(scalars):
        given = f"    if {spec.name} is not _missing: " if spec.anchored else "    "
        text.append(f"{given}_state[{spec.name!r}] = {_canonical(names, k, spec, spec.name)}")
    for held in arrays:
        name = held.name
        taken = [f"{name} = {name}.copy() if {name}.nbytes < _large else _copied({name})", f"{name}.setflags(False)"]
        if held.optional:
            text += [f"    if {name} is not None:", *(f"        {line}" for line in taken)]
        else:
            text += [f"    {line}" for line in taken]
        text.append(f"    _state[{name!r}] = {name}")
    return [*text, "    _self.validate()"] if validates else text


def _adopt(
    names: dict[str, Any], scalars: tuple[ScalarField, ...], arrays: tuple[ArrayField, ...], validates: bool
) -> list[str]:
    given = [f"_a{k}" for k in range(len(arrays))]
    text = [
        "def _adopt(_self, stamp, _header, _given):",
        f"    if _len(_header) != {len(scalars)} or _len(_given) != {len(arrays)}:",
        "        return False",
    ]
    if scalars:
        text.append(f"    {''.join(f'_s{k}, ' for k in range(len(scalars)))} = _header")
        required = [f"_s{k} is None" for k, f in enumerate(scalars) if not f.optional]
        text += [f"    if {' or '.join(required)}:", "        return False"] if required else []
    if arrays:
        frozen = [
            f"({name} is None or ({name}.flags.num & _frozen) == _frozen_is)"
            if spec.optional
            else f"({name}.flags.num & _frozen) == _frozen_is"
            for name, spec in zip(given, arrays, strict=True)
        ]
        text += [
            f"    {''.join(f'{name}, ' for name in given)} = _given",
            f"    if not ({_fit(names, arrays, given)} and {' and '.join(frozen)}):",
            "        return False",
        ]
    text += [
        "    _state = _self.__dict__",
        "    _state['stamp'] = stamp if stamp.__class__ is _int and _min < stamp < _max else _stamp(_schema, stamp)",
        *(f"    _state[{f.name!r}] = {_canonical(names, k, f, f'_s{k}')}" for k, f in enumerate(scalars)),
        *(f"    _state[{f.name!r}] = {name}" for f, name in zip(arrays, given, strict=True)),
        *(["    _self.validate()"] if validates else []),
        "    return True",
    ]
    return text


def _canonical(names: dict[str, Any], k: int, spec: ScalarField, value: str) -> str:
    """An expression for the canonical form of `value`; the general function where it is not in that form already."""
    names[f"_field{k}"] = spec
    test = {
        "bool": f"{value}.__class__ is _bool",
        "int": f"{value}.__class__ is _int and _min <= {value} <= _max",
        "float": f"{value}.__class__ is _float",
        "str": f"{value}.__class__ is _str and {value}.isascii()",
        "strs": f"{value}.__class__ is _tuple and not {value}",
    }[spec.kind]
    if spec.choices:
        names[f"_choices{k}"] = frozenset(spec.choices)
        test = f"{test} and {value} in _choices{k}"
    if spec.optional:
        test = f"{value} is None or ({test})"
    return f"{value} if {test} else _scalar(_schema, _field{k}, {value})"


def _fit(names: dict[str, Any], arrays: tuple[ArrayField, ...], given: list[str]) -> str:
    """A condition: every array has a declared dtype and shape, and equal symbols mean equal extents."""
    conditions = []
    for k, (spec, name) in enumerate(zip(arrays, given, strict=True)):
        for n, dtype in enumerate(spec.dtypes):
            names[f"_type{k}_{n}"] = np.dtype(dtype.str)  # the one object that numpy has for it
        dtypes = " or ".join(f"{name}.dtype is _type{k}_{n}" for n in range(len(spec.dtypes)))
        shapes = " or ".join(
            " and ".join(
                [f"_n{k} == {len(shape)}", *(f"_e{k}[{i}] == {e}" for i, e in enumerate(shape) if e.__class__ is int)]
            )
            for shape in spec.shapes
        )
        fits = [
            f"{name}.__class__ is _ndarray",
            f"({dtypes})",
            f"((_n{k} := _len(_e{k} := {name}.shape)) >= 0)",
            f"({shapes})",
            *_parallel(arrays, given, k),
        ]
        condition = " and ".join(fits)
        conditions.append(f"({name} is None or ({condition}))" if spec.optional else condition)
    return " and ".join(conditions)


def _parallel(arrays: tuple[ArrayField, ...], given: list[str], k: int) -> list[str]:
    """Conditions: the extents of array `k` are those that equal symbols have had before."""
    shared = {e for shape in arrays[k].shapes for e in shape if isinstance(e, str)}
    before = [(j, i, e) for j in range(k) for shape in arrays[j].shapes for i, e in enumerate(shape) if e in shared]
    own = [(i, e) for shape in arrays[k].shapes for i, e in enumerate(shape) if isinstance(e, str)]
    if len(arrays[k].shapes) > 1 or any(len(arrays[j].shapes) > 1 for j, _, _ in before):
        alone = not before and all(len({*shape}) == len(shape) for shape in arrays[k].shapes)
        return [] if alone else ["False"]  # which extent a symbol means depends on the shape: the general way
    conditions = [
        f"({given[j]} is None or _e{j}[{i}] == _e{k}[{at}])" if arrays[j].optional else f"_e{j}[{i}] == _e{k}[{at}]"
        for j, i, symbol in before
        for at, own_symbol in own
        if symbol == own_symbol
    ]
    conditions += [f"_e{k}[{i}] == _e{k}[{j}]" for i, one in own for j, other in own if i < j and one == other]
    return conditions
