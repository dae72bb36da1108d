"""`dataflow models`: what it prints, and its exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from made_towers import write_row as write_towers
from served_models import CONTENT, Served, model_of, write_row
from typer.testing import CliRunner

from operators.models import registry
from operators.models.commands import models


def run(*words: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(models, list(words))
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture
def one(served: Served, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Served:
    """A registry of one's own with the row `net`, whose file the server has."""
    own = write_row(tmp_path / "own.yaml", model_of(CONTENT, url=served.url))
    monkeypatch.setenv(registry.REGISTRIES, own)
    return served


def test_list_shows_licences_and_availability(one: Served) -> None:
    code, out, _ = run("list", "--task", "detection")
    assert code == 0
    rows = {line.split()[0]: line for line in out.splitlines()[1:]}
    assert "CC-BY-4.0" in out  # wrapped in a narrow terminal
    assert " no " in rows["net"]
    assert " yes " in rows["simulated"]
    assert "depth_anything_v2_small" not in out


def test_list_does_not_import_torch(cache: Path) -> None:
    program = "from operators.models.commands import models; models(['list'], standalone_mode=False)"
    check = "import sys; assert not {'torch', 'torchvision', 'onnxruntime'} & sys.modules.keys()"
    done = subprocess.run([sys.executable, "-c", f"{program}; {check}"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "fasterrcnn_mobilenet" in done.stdout


def test_list_and_show_print_rows_as_json(one: Served) -> None:
    code, out, _ = run("list", "--json")
    assert code == 0
    row = next(each for each in json.loads(out) if each["name"] == "yolox_nano")
    assert row["licence"] == {"code": "Apache-2.0", "weights": "Apache-2.0"}
    assert row["file"] is None
    assert json.loads(run("show", "yolox_nano", "--json")[1]) == row


def test_show_prints_the_download_command_and_the_measurements(one: Served, cache: Path) -> None:
    code, out, _ = run("show", "net")
    assert code == 0
    assert "code MIT, weights CC-BY-4.0" in out
    assert "not measured" in out
    assert "dataflow models get net" in " ".join(out.split())


def test_get_prints_the_licence_first_then_the_file(one: Served, cache: Path) -> None:
    code, out, err = run("get", "net")
    assert code == 0
    assert "licence code MIT, weights CC-BY-4.0" in err
    assert out.strip() == str(cache / "net.onnx")
    assert (cache / "net.onnx").read_bytes() == CONTENT
    assert run("get", "net", "--json")[0] == 0
    assert one.asked == [None]


def test_get_without_the_server_is_one_error_line(one: Served, cache: Path) -> None:
    one.code = 503
    code, out, err = run("get", "net")
    assert (code, out) == (1, "")
    assert "answers 503" in err
    assert str(cache / "net.onnx") in err


def test_check_names_the_file_that_differs(one: Served, cache: Path) -> None:
    assert run("get", "net")[0] == 0
    code, out, _ = run("check", "net", "simulated")
    assert code == 0
    assert "net: right" in out
    (cache / "net.onnx").write_bytes(b"other")
    code, out, _ = run("check")
    assert code == 1
    assert f"net: differs: {cache / 'net.onnx'}" in out
    (cache / "net.onnx").unlink()
    assert run("check", "net")[:2] == (1, "net: missing\n")


def test_get_replaces_a_damaged_file(one: Served, cache: Path) -> None:
    assert run("get", "net")[0] == 0
    (cache / "net.onnx").write_bytes(CONTENT[:-1])
    code, _, err = run("get", "net")
    assert code == 0
    assert f"{cache / 'net.onnx'} is not the file of net: its sha256 is " in " ".join(err.split())
    assert (cache / "net.onnx").read_bytes() == CONTENT
    one.code = 503
    (cache / "net.onnx").write_bytes(CONTENT[:-1])
    assert run("get", "net")[0] == 1


def test_get_of_a_damaged_exported_file_names_the_remedy(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(registry.REGISTRIES, write_row(tmp_path / "own.yaml", model_of(CONTENT, export="make it")))
    cache.mkdir()
    (cache / "net.onnx").write_bytes(CONTENT[:-1])
    code, _, err = run("get", "net")
    assert code == 1
    assert "Delete it, then get it anew: export it: make it" in " ".join(err.split())


def test_a_model_that_is_exported_is_taken_from_a_file(cache: Path, tmp_path: Path) -> None:
    code, _, err = run("get", "rf_detr_nano")
    assert code == 1
    assert "its file is not distributed. Export it (RFDETRNano().export()" in err
    (tmp_path / "mine.onnx").write_bytes(CONTENT)
    code, out, _ = run("get", "rf_detr_nano", "--from", str(tmp_path / "mine.onnx"))
    assert (code, out.strip()) == (0, str(cache / "rf_detr_nano.onnx"))
    assert "rf_detr_nano: here, without a digest to compare" in run("check", "rf_detr_nano")[1]


@pytest.mark.parametrize("words", [("show", "yolox_nan"), ("get", "yolox_nan"), ("check", "yolox_nan")])
def test_an_unknown_name_is_refused(words: tuple[str, ...], cache: Path) -> None:
    code, _, err = run(*words)
    assert code == 2
    assert "did you mean 'yolox_nano'?" in err


def test_get_brings_the_parts_of_a_model_too_and_check_names_each(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / "made"
    monkeypatch.setenv(registry.REGISTRIES, str(write_towers(made)))
    assert run("check", "colors")[:2] == (1, "colors: missing\ncolors.text: missing\ncolors.tokenizer: missing\n")
    code, out, _ = run("get", "colors")
    assert code == 0
    assert [Path(line).name for line in out.splitlines()] == ["colors.onnx", "colors.text.onnx", "colors.tokenizer.txt"]
    assert run("check", "colors")[0] == 0
    (cache / "colors.tokenizer.txt").unlink()
    code, out, _ = run("check")
    assert (code, "colors.tokenizer: missing" in out) == (1, True)
    assert " no " in next(line for line in run("list", "--task", "embedding")[1].splitlines() if "colors" in line)
    assert "colors.tokenizer is not on this machine" in " ".join(run("show", "colors")[1].split())
    code, out, _ = run("get", "colors.tokenizer", "--from", str(made / "cache" / "colors.tokenizer.txt"))
    assert (code, out.strip()) == (0, str(cache / "colors.tokenizer.txt"))
    code, _, error = run("get", "colors.text", "--from", str(made / "cache" / "colors.onnx"))
    assert (code, "colors.text: what arrived is another file" in " ".join(error.split())) == (1, True)
