"""Saved maps of objects: one NumPy archive (.npz) with the classes that were learned for them."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from operators.labels import LabelSpace

KIND, VERSION = "semantic map", 1


@dataclass(frozen=True)
class LearnedFile:
    """A file of `dataflow learn object` as it stands: its name without folders, and its bytes."""

    name: str
    content: bytes

    @property
    def digest(self) -> str:
        """SHA-256 of the content."""
        return hashlib.sha256(self.content).hexdigest()


@dataclass(frozen=True)
class SavedMap:
    """A map of objects and surfaces: names of its classes, its frame, the side of its voxels (m), what it holds, and
    the learned classes that were in use."""

    classes: tuple[str, ...]
    frame: str
    voxel: float
    objects: Mapping[str, Any]
    surfaces: Mapping[str, Any]
    learned: tuple[LearnedFile, ...] = ()

    def write(self, path: Path) -> None:
        """Writes the map; the same map gives the same bytes."""
        kept = bytearray()
        state = _flat({"objects": self.objects, "surfaces": self.surfaces}, kept)
        facts = {
            "kind": KIND,
            "version": VERSION,
            "classes": list(self.classes),
            "frame": self.frame,
            "voxel": self.voxel,
            "learned": [{"name": each.name, "sha256": each.digest} for each in self.learned],
            "state": state,
        }
        arrays: dict[str, Any] = {"facts": json.dumps(facts), "arrays": np.frombuffer(bytes(kept), np.uint8)}
        arrays |= {f"learned_{k}": np.frombuffer(each.content, np.uint8) for k, each in enumerate(self.learned)}
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial")
        with partial.open("wb") as handle:
            np.savez_compressed(handle, **arrays)
        partial.replace(path)

    def begun(self, stamp: int, classes: Sequence[str], labels: LabelSpace) -> tuple[dict[str, Any], dict[str, Any]]:
        """Returns the states of objects and surfaces from which a map goes on at `stamp`, with these names of classes.

        Agents are not there any more, nor is what had vanished; times that are not before `stamp` become so. Raises
        ValueError where a class of the map is not among `classes`.
        """
        lacking = [name for name in self.classes if name not in classes]
        if lacking:
            raise ValueError(f"the saved map has the classes {lacking}, which boxes do not have: {list(classes)}")
        place = [list(classes).index(name) for name in self.classes] or [0]
        objects = []
        for each in self.objects["objects"]:
            votes = np.zeros(max(len(classes), 1))
            votes[place] = each["votes"]
            if not classes or "agent" not in labels.roles(classes[int(votes.argmax())]):
                objects.append({**_before(each, stamp), "votes": votes, "velocity": np.zeros(3), "tracks": []})
        surfaces = [_before(each, stamp) for each in self.surfaces["surfaces"]]
        kept = {**self.objects, "objects": objects, "gone": [], "recent": [], "stamp": None}
        return kept, {**self.surfaces, "surfaces": surfaces}

    @classmethod
    def read(cls, path: Path) -> SavedMap:
        """Raises FileNotFoundError, and ValueError for a file that is none, is damaged or is of another version."""
        if not path.is_file():
            raise FileNotFoundError(f"no saved map {str(path)!r} (looked for {path.absolute()})")
        try:
            with np.load(path, allow_pickle=False) as archive:
                facts = json.loads(str(archive["facts"]))
                if facts.get("kind") != KIND:
                    raise ValueError("it holds something else")
                if facts["version"] != VERSION:
                    raise ValueError(f"it has version {facts['version']}; this program reads version {VERSION}")
                state = _deep(facts["state"], archive["arrays"].tobytes())
                learned = tuple(
                    LearnedFile(each["name"], archive[f"learned_{k}"].tobytes())
                    for k, each in enumerate(facts["learned"])
                )
            for told, each in zip(facts["learned"], learned, strict=True):
                if told["sha256"] != each.digest:
                    raise ValueError(f"the learned class {each.name} is not the one that was saved")
            return cls(
                tuple(map(str, facts["classes"])),
                str(facts["frame"]),
                float(facts["voxel"]),
                state["objects"],
                state["surfaces"],
                learned,
            )
        except (ValueError, KeyError, TypeError, AttributeError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{path} is no saved map ({error}); SemanticMap writes one with the parameter save"
            ) from None


def learned_files(path: Path) -> tuple[LearnedFile, ...]:
    """Returns the learned classes that a file stands for: its own, or those of a saved map.

    Raises FileNotFoundError, and ValueError for a saved map that is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no learned object {str(path)!r} (looked for {path.absolute()})")
    if _is_map(path):
        return SavedMap.read(path).learned
    return (LearnedFile(path.name, path.read_bytes()),)


def together(*groups: Sequence[LearnedFile]) -> tuple[LearnedFile, ...]:
    """Returns the files of all groups in order, each content once."""
    found: dict[str, LearnedFile] = {}
    for group in groups:
        for each in group:
            found.setdefault(each.digest, each)
    return tuple(found.values())


def _before(entry: Mapping[str, Any], stamp: int) -> dict[str, Any]:
    before = stamp - 1
    times: dict[str, Any] = {
        "born": min(entry["born"], before),
        "seen": min(entry["seen"], before),
        "cells": {**entry["cells"]},
    }
    times["cells"]["times"] = np.full(len(entry["cells"]["hits"]), float(before))
    if "image_stamps" in entry:
        times["image_stamps"] = [before] * len(entry["image_stamps"])
    return {**entry, **times}


def _is_map(path: Path) -> bool:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return bool(json.loads(str(archive["facts"])).get("kind") == KIND)
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
        return False  # reading it raises the error


def _flat(value: Any, kept: bytearray) -> Any:
    """Returns a state for JSON: arrays become {"array": [type, shape, place]} and their bytes are added to `kept`."""
    match value:
        case np.ndarray():
            place = len(kept)
            kept += np.ascontiguousarray(value).tobytes()
            return {"array": [value.dtype.str, list(value.shape), place]}
        case np.generic():
            return value.item()
        case Mapping():
            return {key: _flat(value[key], kept) for key in sorted(value)}
        case list() | tuple():
            return [_flat(item, kept) for item in value]
        case _:
            return value


def _deep(value: Any, kept: bytes) -> Any:
    match value:
        case {"array": [kind, shape, place]}:
            count = int(np.prod(shape, dtype=np.int64))
            return np.frombuffer(kept, np.dtype(kind), count, place).reshape(shape).copy()
        case dict():
            return {key: _deep(item, kept) for key, item in value.items()}
        case list():
            return [_deep(item, kept) for item in value]
        case _:
            return value
