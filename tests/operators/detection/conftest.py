from __future__ import annotations

import pytest

from tests.support.drives import Drive


@pytest.fixture(scope="session")
def drive() -> Drive:
    return Drive()
