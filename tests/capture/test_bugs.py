"""Every seeded bug becomes a small test that fails with it and passes without it."""

from __future__ import annotations

from pathlib import Path

import pytest
import seeded_bugs
from zoo import bugs

from dataflow.capture.capture import CaptureResult


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[CaptureResult, int, Path]]:
    folder = tmp_path_factory.mktemp("bugs")
    made = {}
    for case in bugs.CASES:
        name = case.use.__name__
        path = seeded_bugs.recorded(case, folder / f"{name}.mcap")
        one, nbytes, _ = seeded_bugs.captured(case, path, folder / f"test_{name}.py")
        path.unlink()  # the test is alone
        made[name] = one, nbytes, folder / f"test_{name}.py"
    return made


@pytest.mark.long
def test_every_bug_is_captured_small(found: dict[str, tuple[CaptureResult, int, Path]]) -> None:
    assert len(found) == 10
    for name, (one, nbytes, _) in found.items():
        assert one.calls > 40, name
        assert one.left <= max(1, one.calls // 100), (name, one.left, one.calls)
        assert nbytes <= 1_000_000
    assert {name for name, (one, _, _) in found.items() if "may be wrong" in one.begins} == set()


@pytest.mark.long
def test_the_tests_fail_alone_and_pass_on_mended_code(found: dict[str, tuple[CaptureResult, int, Path]]) -> None:
    tests = [test for _, _, test in found.values()]

    assert seeded_bugs.outcomes(tests, fixed=False) == {test.stem: False for test in tests}
    assert seeded_bugs.outcomes(tests, fixed=True) == {test.stem: True for test in tests}
