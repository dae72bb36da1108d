"""Errors name the extra that brings a missing package."""

from __future__ import annotations

import pytest

from dataflow.extras import is_optional, missing_extra


def failed(module: str, importer: str) -> ModuleNotFoundError:
    """Returns the error of an import of a missing module in a module of that name."""
    try:
        exec(
            "raise ModuleNotFoundError(f'No module named {name!r}', name=name)", {"__name__": importer, "name": module}
        )
    except ModuleNotFoundError as error:
        return error
    raise AssertionError


@pytest.mark.parametrize(
    ("module", "importer", "extra"),
    [
        ("cv2", "operators.codec.decoder", "perception"),
        ("cv2", "dataflow.view.visualizers.cameras", "view"),
        ("scipy.optimize", "dataflow.lint.clocks", "bags"),
        ("rerun", "dataflow.view.sink", "view"),
        ("small_gicp", "operators.odometry", "perception"),
        ("open3d", "operators.sources", "sim"),
        ("pandas", "dataflow.api.frames", "notebook"),
    ],
)
def test_extra_is_that_of_the_importing_package(module: str, importer: str, extra: str) -> None:
    assert missing_extra(failed(module, importer)) == f"it comes with: pip install 'robot-dataflow[{extra}]'"


@pytest.mark.parametrize(("machine", "more"), [("x86_64", ""), ("aarch64", "where platform_machine != ")])
def test_condition_on_the_processor_is_given_where_it_concerns_this_one(
    machine: str, more: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.machine", lambda: machine)
    told = missing_extra(failed("vqf", "operators.fusion.orientation"))
    assert told.startswith("it comes with: pip install 'robot-dataflow[perception]'")
    assert told.endswith('python_version < "3.12"') is bool(more)
    assert more in told
    assert "where" not in missing_extra(failed("cv2", "operators.codec"))


def test_cause_of_an_error_is_searched() -> None:
    outer = ValueError("cannot load")
    outer.__cause__ = failed("rerun", "dataflow.view.sink")
    assert missing_extra(outer).endswith("[view]'")


def test_modules_of_others_have_no_extra() -> None:
    assert missing_extra(failed("my_robot", "operators.codec")) == ""
    assert missing_extra(ValueError()) == ""


def test_packages_of_the_base_are_not_optional() -> None:
    assert is_optional("cv2")
    assert not any(map(is_optional, ("numpy", "zenoh", "mcap", "ruamel")))
