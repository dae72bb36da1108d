"""The registry of models: what each network is for, how it is read, whose it is, and where its file comes from."""

from __future__ import annotations

import os
from collections.abc import Iterator
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from operators.inference import ModelError

Task = Literal["detection", "segmentation", "depth", "keypoints", "masks", "embedding"]
PartName = Literal["text", "tokenizer"]

REGISTRIES = "DATAFLOW_MODELS"
"""Environment variable: further registry files, separated as PATH is; their rows go before those of the project."""
NOT_MEASURED = "not measured"

_FILE = Path(__file__).with_name("registry.yaml")
_WEIGHTS = Path(__file__).parents[1] / "weights"


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Source(_Row):
    """The source of a model's file: one of these, the others None.

    - `url`: of http, https or file. `package` and `member`: a package of `index` that carries the file, as
      `name==version` of pypi or `name@version` of npm, and the file's path in it.
    - `torchvision`: the name of torchvision's weights (`COCO_V1`), which its hub keeps as the file `member`.
    - `shipped`: a file of the project's.
    - `export`: how the file is made, where it is not distributed.
    """

    url: str | None = None
    index: Literal["pypi", "npm"] | None = None
    package: str | None = None
    member: str | None = None
    torchvision: str | None = None
    shipped: str | None = None
    export: str | None = None

    @model_validator(mode="after")
    def _one(self) -> Source:
        given = [self.url, self.index, self.torchvision, self.shipped, self.export]
        if sum(each is not None for each in given) != 1:
            raise ValueError("one of url, index with package and member, torchvision, shipped, export must be given")
        packaged = (self.index, self.package)
        if any(packaged) != all(packaged) or any((*packaged, self.torchvision)) != (self.member is not None):
            raise ValueError("index, package and member come together, and torchvision and member")
        if self.url is not None and not self.url.startswith(("https://", "http://", "file://")):
            raise ValueError(f"url must begin with https://, http:// or file://, is {self.url!r}")
        return self

    def __str__(self) -> str:
        if self.index is not None:
            return f"{self.member} in {self.package} of {self.index}"
        if self.torchvision is not None:
            return f"torchvision's hub, {self.torchvision}"
        if self.shipped is not None:
            return "comes with the project"
        return self.url if self.url is not None else f"export it: {self.export}"


class Licence(_Row):
    """Licences by their SPDX names, of the code that defines the network and of its weights."""

    code: str
    weights: str

    def __str__(self) -> str:
        return self.code if self.code == self.weights else f"code {self.code}, weights {self.weights}"


Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Part(_Row):
    """A further file that a model needs: where it is from, and its digest."""

    source: Source
    sha256: Digest | None = None
    bytes: Annotated[int, Field(gt=0)] | None = None


class Model(_Row):
    """One row of the registry.

    - `operator`: the import path of the operator that runs it; `params`: its parameters where others are not given.
    - `classes`: a list of names, the name of one (`coco`), or None for networks without.
    - `sha256` of the file; None where the user exports it. `bytes`: its size, where that is known. `exports`: sha256 of
      other files of the same network, exported otherwise, which the row describes as well.
    - `parts`: further files, the tower of text or the tokenizer.
    - `published`: the authors' figure; `measured`: the one found here, with its command, or `not measured`.
    """

    name: str
    about: str
    task: Task
    operator: str
    params: dict[str, Any] = {}
    classes: str | list[str] | None = None
    input: str
    licence: Licence
    source: Source
    home: str
    sha256: Digest | None = None
    bytes: Annotated[int, Field(gt=0)] | None = None
    exports: list[Digest] = []
    parts: dict[PartName, Part] = {}
    published: str
    measured: str = NOT_MEASURED

    @model_validator(mode="after")
    def _checked(self) -> Model:
        for source, sha256 in ((self.source, self.sha256), *((p.source, p.sha256) for p in self.parts.values())):
            if (source.url is not None or source.index is not None) and sha256 is None:
                raise ValueError("sha256 must be given for a file that is downloaded")
        return self

    @property
    def files(self) -> list[Model]:
        """Returns its row, and one for each of its parts."""
        return [self, *map(self.part, self.parts)]

    def part(self, name: PartName) -> Model:
        """Returns the row of a part, named `MODEL.PART`. Raises ModelError where it has none."""
        if name not in self.parts:
            raise ModelError(f"the registry's row {self.name} has no {name} among its parts")
        given = self.parts[name]
        changed = {"source": given.source, "sha256": given.sha256, "bytes": given.bytes}
        return self.model_copy(update={"name": f"{self.name}.{name}", "exports": [], "parts": {}, **changed})

    @property
    def file_name(self) -> str:
        """Name of its file in the cache: that of the model, with the ending that its source has."""
        ending = Path(self.source.member or self.source.url or "x.onnx").suffix
        return f"{self.name}{ending or '.onnx'}"

    @property
    def file(self) -> Path:
        """Place of its file: in the project, or in the cache."""
        return _WEIGHTS / self.source.shipped if self.source.shipped is not None else cache_folder() / self.file_name

    def accepts(self, sha256: str) -> bool:
        """Returns whether a file with this digest is the model's."""
        return self.sha256 is None or sha256 == self.sha256 or sha256 in self.exports


class Registry:
    """The rows of registry files by name; a name in an earlier file hides those after it."""

    def __init__(self, files: list[Path]) -> None:
        """Raises ModelError for a file that is missing or no registry."""
        self._models: dict[str, Model] = {}
        for file in files:
            for model in _read(file):
                self._models.setdefault(model.name, model)

    @classmethod
    def load(cls) -> Registry:
        """Reads the files that `DATAFLOW_MODELS` names, and the project's own."""
        named = [Path(part).expanduser() for part in os.environ.get(REGISTRIES, "").split(os.pathsep) if part]
        return _loaded((*named, _FILE))

    def __iter__(self) -> Iterator[Model]:
        return iter(sorted(self._models.values(), key=lambda model: (model.task, model.name)))

    def __contains__(self, name: object) -> bool:
        return name in self._models

    def __getitem__(self, name: str) -> Model:
        """Returns a row, or that of a part, `MODEL.PART`. Raises ModelError for others, with the nearest name."""
        for whole in self._models.values() if name not in self._models else ():
            for each in whole.files[1:]:
                if each.name == name:
                    return each
        if name not in self._models:
            near = get_close_matches(name, self._models, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise ModelError(f"there is no model {name!r}; {hint}`dataflow models list` prints them")
        return self._models[name]

    def with_digest(self, sha256: str) -> Model | None:
        """Returns the model that a file with this digest is; None for a file of no row."""
        rows = (m for m in self if m.sha256 is not None and m.accepts(sha256))
        return next(rows, None)


def cache_folder() -> Path:
    """Returns the folder of downloaded models: `DATAFLOW_MODEL_CACHE`, else `dataflow/models` in the user's cache."""
    own = os.environ.get("DATAFLOW_MODEL_CACHE")
    if own:
        return Path(own).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "dataflow" / "models"


@cache
def _loaded(files: tuple[Path, ...]) -> Registry:
    return Registry(list(files))


def _read(file: Path) -> Iterator[Model]:
    try:
        content = YAML(typ="safe", pure=True).load(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ModelError(f"there is no registry of models {file} ({REGISTRIES} names it)") from None
    except (YAMLError, UnicodeDecodeError, OSError) as error:
        raise ModelError(f"{file} is no YAML: {error}") from None
    rows = content.get("models") if isinstance(content, dict) else None
    if not isinstance(rows, dict):
        raise ModelError(f"{file} is no registry of models: it must hold `models:` with a row for each name")
    for name, row in rows.items():
        try:
            yield Model.model_validate({"name": name, **(row if isinstance(row, dict) else {})})
        except ValidationError as error:
            faults = (f"{'.'.join(map(str, e['loc'])) or 'the row'}: {e['msg']}" for e in error.errors())
            raise ModelError(f"{file}: models.{name}: {'; '.join(faults)} (docs/models.md describes a row)") from None
