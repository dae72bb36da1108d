"""The faults that are planted to try the tests are valid code, each in one place, and repeat by their seed."""

from __future__ import annotations

from pathlib import Path

from mutants import drawn, mutants_of

SOURCE = '''
def share(a: int | None, b: float = 0.5) -> float:
    """Returns 1 + 1."""
    if not a:
        raise ValueError(f"{a + 1}")
    self.total[a] = b
    log(a)
    return a + b < 2.5 and True
'''


def test_faults_are_comparisons_operators_numbers_returns_and_dropped_statements() -> None:
    source = SOURCE.encode()
    found = {(source[m.start : m.end].decode(), m.text): m.written(source) for m in mutants_of(Path("a.py"), source)}

    assert set(found) == {
        ("0.5", "(1.5)"),
        ("not a", "(a)"),
        ("self.total[a] = b", "pass"),
        ("log(a)", "pass"),
        ("return a + b < 2.5 and True", "return None"),
        ("a + b < 2.5 and True", "(a + b < 2.5 or True)"),
        ("a + b < 2.5", "(a + b <= 2.5)"),
        ("a + b", "(a - b)"),
        ("2.5", "(3.5)"),
        ("True", "False"),
    }
    for text in found.values():
        compile(text, "a.py", "exec")


def test_a_seed_draws_equal_faults(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(SOURCE)

    assert drawn(tmp_path, 4, 1) == drawn(tmp_path, 4, 1) != drawn(tmp_path, 4, 2)
    assert len(drawn(tmp_path / "a.py", 60, 1)) == 10
