"""`dataflow lint` on recordings: tables, JSON, exit codes, contracts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.lint.contract import ContractError, load_contract
from dataflow.recording import RecordingWriter


def call(*words: object, code: int = 0):
    outcome = CliRunner().invoke(app, [str(word) for word in words])
    assert outcome.exit_code == code, (outcome.stdout, outcome.stderr, outcome.exception)
    return outcome


@pytest.fixture(scope="module")
def demo(repository: Path) -> Path:
    return repository / "recordings" / "demo.mcap"


def test_bundled_recording_is_sound_and_its_camera_clock_is_estimated(demo: Path) -> None:
    found = json.loads(call("lint", demo, "--json").stdout)
    assert found["sound"]
    assert found["clocks"]["robot1/robot/image_jpeg"]["likeness"] > 0.9
    assert abs(found["clocks"]["robot1/robot/image_jpeg"]["offset_s"]) < 0.03
    assert found["streams"]["robot1/robot/imu"]["hz"] == pytest.approx(100)


@pytest.mark.long
def test_a_proposed_contract_is_kept_and_a_stricter_one_is_not(demo: Path, tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    call("lint", demo, "--quick", "--write-contract", file)
    assert "nothing was found" in call("lint", demo, "--quick", "--contract", file).stdout
    assert "exists; name another file" in call("lint", demo, "--write-contract", file, code=2).stderr

    file.write_text(file.read_text().replace("type: Imu", "type: Imu2"))
    told = call("lint", demo, "--quick", "--contract", file, code=1).stdout
    assert "error   contract  robot/imu: is of type Imu; the contract wants Imu2" in told


def test_the_contract_on_the_page_can_be_read(repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "recordings.md").read_text(encoding="utf-8")
    file = tmp_path / "robot.yaml"
    file.write_text(page.split("```yaml\ncontract")[1].split("```")[0].join(("contract", "")))
    contract = load_contract(file)
    assert contract.terms_of("robot1/robot/imu", "robot1").max_gap == pytest.approx(0.03)
    assert contract.terms_of("robot1/camera/left", "robot1").allow == ("gap",)
    assert contract.clocks.max_offset == pytest.approx(0.01)


def test_a_recording_without_a_stream_is_not_called_sound(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "empty.mcap", metadata={}):
        pass
    assert "there is no stream that could be looked at" in call("lint", tmp_path / "empty.mcap").stdout


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("streams: {imu: {rte: [1, 2]}}", "streams.imu.rte: unknown key; did you mean 'rate'?"),
        ("streams: {imu: {rate: [3, 2]}}", "expected [least, largest]"),
        ("streams: {imu: {max_gap: 3}}", "a duration with a unit, such as 30ms"),
        ("clock: {}", "unknown key; did you mean 'clocks'?"),
        ("[]", "expected a mapping"),
        ("a: [", "no YAML"),
    ],
)
def test_faulty_contract_is_refused_with_place_and_hint(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(text)
    with pytest.raises(ContractError) as raised:
        load_contract(file)
    assert words in str(raised.value)
