"""The networks that come with the project, and the file format that training writes and operators read."""

from operators.weights.network_file import (
    Network,
    NetworkFileError,
    SecondNetwork,
    facts_of,
    kind_of,
    open_kind,
    open_network,
    open_second,
    read_facts,
    shipped,
    trained_in_simulation,
    training_seed,
)

__all__ = [
    "Network",
    "NetworkFileError",
    "SecondNetwork",
    "facts_of",
    "kind_of",
    "open_kind",
    "open_network",
    "open_second",
    "read_facts",
    "shipped",
    "trained_in_simulation",
    "training_seed",
]
