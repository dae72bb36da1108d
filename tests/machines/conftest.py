"""An agent that plays the other machine."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator

import pytest
from joined_agents import HERE, Robot, end, join

sys.path.append(str(HERE))


@pytest.fixture(scope="module")  # other tests end every process that was left
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A machine called robot, which takes part in one run after the other; joined over a socket of this user."""
    folder = tmp_path_factory.mktemp("robot")
    endpoint = f"unixsock-stream/{folder / 'meet'}"
    code = folder / "code"
    shutil.copytree(HERE, code)
    process = join("robot", endpoint, folder / "files", code=code)
    yield Robot(endpoint, folder / "files", code, process)
    assert process.poll() is None
    end(process)
