"""Commands of other packages: found by entry point, and never able to break the others."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli import plugins
from dataflow.cli.main import app

MODULE = '''
import typer

polish = typer.Typer(help="Polish things.")

@polish.command()
def floor(times: int = 1):
    """Polish the floor."""
    print(f"polished the floor {times} times")

@polish.command()
def lens():
    """Polish the lens."""

shine = typer.Typer()

@shine.command()
def _shine():
    """Make it shine."""

def greet(name: str):
    """Greet somebody."""
    print(f"hello {name}")

number = 3
'''
ENTRIES = """\
[dataflow.commands]
polish = plugin_of_tests:polish
greet = plugin_of_tests:greet
shine = plugin_of_tests:shine
number = plugin_of_tests:number
absent = plugin_of_tests:absent
raises = broken_plugin_of_tests:command
run = plugin_of_tests:greet
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A package with seven entry points: three good, three broken, one that names a built-in command."""
    (tmp_path / "plugin_of_tests.py").write_text(MODULE)
    (tmp_path / "broken_plugin_of_tests.py").write_text("raise RuntimeError('no licence')\n")
    info = tmp_path / "polisher-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: polisher\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    monkeypatch.syspath_prepend(str(tmp_path))
    plugins.advertised.cache_clear()
    yield
    plugins.advertised.cache_clear()
    sys.modules.pop("plugin_of_tests", None)


@pytest.mark.usefixtures("installed")
def test_a_function_and_a_group_of_commands_can_be_called() -> None:
    assert CliRunner().invoke(app, ["greet", "Ada"]).stdout == "hello Ada\n"
    assert CliRunner().invoke(app, ["polish", "floor", "--times", "2"]).stdout == "polished the floor 2 times\n"


@pytest.mark.usefixtures("installed")
def test_the_help_lists_them_and_the_broken_ones_with_their_error() -> None:
    told = CliRunner().invoke(app, ["--help"])

    assert told.exit_code == 0
    assert "Greet somebody." in told.stdout
    assert "Polish things." in told.stdout
    assert "no licence" in told.stdout
    assert "plugin_of_tests:greet supplies a command 'run', which is built in" in told.stderr


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("command", "message"),
    [("raises", "RuntimeError: no licence"), ("absent", "AttributeError"), ("number", "expected a typer.Typer")],
)
def test_broken_plugin_reports_reason_and_exits_with_2(command: str, message: str) -> None:
    told = CliRunner().invoke(app, [command, "--anything", "x"])

    assert told.exit_code == 2
    assert message in told.stderr
    assert "of package polisher" in told.stderr
    assert "Traceback" not in told.stderr


@pytest.mark.usefixtures("installed")
def test_built_in_commands_neither_load_nor_yield_to_them(small: Path) -> None:
    assert CliRunner().invoke(app, ["check", str(small)]).exit_code == 0
    assert "plugin_of_tests" not in sys.modules
    assert "Run a graph." in CliRunner().invoke(app, ["run", "--help"]).stdout


@pytest.mark.usefixtures("installed")
def test_a_misspelt_one_is_suggested() -> None:
    assert "Did you mean 'polish'" in CliRunner().invoke(app, ["polis"]).stderr


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("command", ["polish", "greet", "shine"])
def test_each_stands_among_the_commands_of_other_packages(command: str) -> None:
    found = plugins.load(plugins.advertised()[command])
    assert found.rich_help_panel == plugins.PANEL
