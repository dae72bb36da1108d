"""The catalogue finds operators, tells what they declare, and reports modules that fail."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import pkgutil
import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import graph_operators
import pytest
from rich.console import Console, RenderableType

from dataflow.graph.catalogue import BUILT_IN, CatalogueEntry, discover, find, look_up, page, parameters, table
from dataflow.graph.lookup import is_concrete
from dataflow.messages import Number
from dataflow.operator import KEPT, In, Operator


def shown(renderable: RenderableType) -> str:
    out = io.StringIO()
    Console(file=out, width=160, color_system=None).print(renderable)
    return out.getvalue()


def test_every_operator_of_a_module_is_found() -> None:
    catalogue = discover(["graph_operators"])
    assert set(catalogue.operators) == {
        f"graph_operators:{name}"
        for name in (
            "Camera", "CloudBuilder", "Detector", "Device", "Echo", "Fuse", "Log", "Mapper", "Odometry", "StaticUser",
            "Ticker", "Watchdog",
        )
    }  # fmt: skip
    assert not catalogue.failures
    assert find(catalogue, "CloudBuilder").operator is graph_operators.CloudBuilder
    assert find(catalogue, "graph_operators:Fuse").use == "graph_operators:Fuse"
    with pytest.raises(LookupError, match="no operator 'CloudBilder': did you mean 'CloudBuilder'"):
        find(catalogue, "CloudBilder")
    with pytest.raises(LookupError, match="has no operator 'Fus'; did you mean 'Fuse'"):
        find(catalogue, "graph_operators:Fus")
    assert "graph_operators:Fuse" in shown(table(catalogue))


def test_an_operator_is_found_by_its_former_path(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = {"graph_operators:Merger": "graph_operators:Fuse", "graph_operators:Gone": "graph_operators:Nowhere"}
    monkeypatch.setattr(graph_operators, "MOVED_OPERATORS", moved, raising=False)

    assert look_up("graph_operators:Merger") == CatalogueEntry("graph_operators:Fuse", graph_operators.Fuse)
    with pytest.raises(LookupError, match="module 'graph_operators' has no operator 'Nowhere'"):
        look_up("graph_operators:Gone")


def test_a_failing_module_is_reported_and_the_others_still_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "half_broken"
    package.mkdir()
    (package / "__init__.py").write_text("from half_broken.good import Good\n")
    (package / "good.py").write_text(
        "from dataflow.operator import Operator, In\nfrom graph_operators import Pose\n"
        "class Good(Operator):\n    '''Fine.'''\n    pose: In[Pose]\n    def process(self, pose): return None\n"
    )
    (package / "bad.py").write_text("import no_such_library_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    catalogue = discover(["half_broken"])
    assert list(catalogue.operators) == ["half_broken:Good"]
    (failure,) = catalogue.failures
    assert str(failure) == "half_broken.bad: ModuleNotFoundError: No module named 'no_such_library_at_all'"
    assert "no_such_library_at_all" in shown(table(catalogue))


def test_description_holds_ports_parameters_bounds_units_and_docs() -> None:
    camera = CatalogueEntry("graph_operators:Camera", graph_operators.Camera).to_json()
    assert camera["source"]
    assert camera["params"][0] == {
        "name": "rate",
        "type": "float",
        "required": False,
        "default": 30.0,
        "bounds": "> 0",
        "unit": "Hz",
        "tunable": False,
        "doc": "pictures a second",
    }
    assert [(o["name"], o["types"], o["static"]) for o in camera["outputs"]] == [
        ("image", ["TestPicture"], False),
        ("depth", ["TestDepth"], False),
        ("info", ["TestLens"], True),
    ]
    odometry = CatalogueEntry("graph_operators:Odometry", graph_operators.Odometry).to_json()
    assert [(i["name"], i["kind"], i["required"], i["before"]) for i in odometry["inputs"]] == [
        ("image", "in", True, 0),
        ("map", "sampled", False, 1),
        ("hint", "sampled", False, 0),
    ]
    assert (
        CatalogueEntry("x:Mapper", graph_operators.Mapper).to_json()["fires"] == "on cloud and pose joined within 20ms"
    )
    assert CatalogueEntry("x:Watchdog", graph_operators.Watchdog).to_json()["fires"] == "every 100ms"


def test_details_show_everything_declared() -> None:
    text = shown(page(CatalogueEntry("graph_operators:CloudBuilder", graph_operators.CloudBuilder)))
    for words in ("CloudBuilder", "In", "TestDepth", "depth image", ">= 1", "fast", "keep every stride-th pixel"):
        assert words in text
    (window,) = [row for row in parameters(graph_operators.CloudBuilder) if row["name"] == "window"]
    assert (window["type"], window["default"]) == ("duration", "0s")
    text = shown(page(CatalogueEntry("graph_operators:Detector", graph_operators.Detector)))
    assert "must be given" in text
    assert "list[str]" in text


@dataclass
class Seen:
    last: Number | None = None
    ages: dict[int, list[float]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter, metadata=KEPT)


class Watching(Operator):
    number: In[Number]
    state: Seen

    def process(self, number: Number) -> None: ...


class WatchingMore(Watching):
    """Inherits its state."""


def test_the_fields_of_a_declared_state_are_shown_with_their_types() -> None:
    for cls in (Watching, WatchingMore):
        assert CatalogueEntry("x:Watching", cls).to_json()["state"] == [
            {"name": "last", "type": "Number | None", "kept": False},
            {"name": "ages", "type": "dict[int, list[float]]", "kept": False},
            {"name": "counts", "type": "Counter[str]", "kept": True},
        ]
        text = shown(page(CatalogueEntry("x:Watching", cls)))
        assert re.search(r"ages +dict\[int, list\[float\]\]", text)
        assert re.search(r"counts +Counter\[str\] +kept by a reset of the clock", text)
    assert CatalogueEntry("x:Mapper", graph_operators.Mapper).to_json()["state"] == []


def test_single_operator_is_looked_up_by_name_or_path() -> None:
    assert look_up("CloudBuilder").use == "operators.cloud:CloudBuilder"
    assert look_up("graph_operators:CloudBuilder").operator is graph_operators.CloudBuilder
    with pytest.raises(LookupError, match="no operator 'CloudBilder': did you mean 'CloudBuilder'"):
        look_up("CloudBilder")
    assert list(discover(["graph_operators"], "Fuse").operators) == ["graph_operators:Fuse"]


def test_the_built_in_packages_export_all_their_operators() -> None:
    """Only what they export is listed, so that their other modules need not be imported."""
    for module in pkgutil.walk_packages(importlib.import_module("operators").__path__, "operators."):
        with contextlib.suppress(ImportError):  # an optional package is missing
            importlib.import_module(module.name)
    made = [Operator]
    for cls in made:
        made += cls.__subclasses__()
    own = {cls for cls in made if is_concrete(cls) and cls.__module__.startswith("operators.")}

    catalogue = discover(BUILT_IN)

    assert {cls for cls in own if not cls.__name__.startswith("_")} == set(catalogue.operators.values())
    assert len(own) > 80


def test_an_export_that_fails_to_import_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("operators.cloud.CloudFilter", raising=False)  # looked up, and so imported
    monkeypatch.setitem(sys.modules, "operators.cloud.cloud_filter", None)

    (failure,) = discover(BUILT_IN).failures

    assert str(failure).startswith("operators.cloud:CloudFilter: ModuleNotFoundError")
    with pytest.raises(LookupError, match=r"no operator 'CloudFilter'.*failed to import operators.cloud:CloudFilter"):
        look_up("CloudFilter")


def test_the_installed_catalogue_is_json() -> None:
    catalogue = discover()
    assert "operators" in catalogue.found_in
    json.dumps(catalogue.to_json(), allow_nan=False)
