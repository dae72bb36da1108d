"""The goal network in use: scores of the candidates of an agent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.inference import open_session
from operators.scene.goals import NAMES, Score
from operators.weights import NetworkFileError, facts_of

KIND = "goals"
_LACKING = "train one by `dataflow train goals`"


def open_goal_network(file: Path) -> Score:
    """Opens a network for one CPU thread, so that equal candidates get equal scores.

    Raises FileNotFoundError, or NetworkFileError where the file is no goal network for our descriptions.
    """
    session = open_session(file)
    facts = facts_of(file, session, ("kind",))
    if facts["kind"] != KIND:
        raise NetworkFileError(f"{file} is of the kind {facts['kind']}; a {KIND} network is needed: {_LACKING}")
    if tuple(facts.get("features", ())) != NAMES:
        raise NetworkFileError(f"{file} was trained on other descriptions than these {len(NAMES)}: {_LACKING}")

    def score(rows: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(session.run(None, {"rows": rows})[0], np.float32)

    return score
