"""The worlds by name."""

from __future__ import annotations

from collections.abc import Callable

from operators.simulator.scene import World, WorldOptions
from operators.simulator.worlds.corridor import corridor
from operators.simulator.worlds.office import office
from operators.simulator.worlds.table_top import table_top
from operators.simulator.worlds.yard import yard

_MAKERS: dict[str, Callable[[int, WorldOptions], World]] = {
    "office": office,
    "corridor": corridor,
    "table_top": table_top,
    "yard": yard,
}
NAMES = tuple(_MAKERS)
INDOOR = ("office", "corridor", "table_top")


def make_world(
    name: str,
    seed: int,
    *,
    speed: float,
    hold: float,
    movers: bool,
    people: int = 2,
    tour: bool = False,
    jumps: tuple[tuple[float, float], ...] = (),
) -> World:
    """A world drawn from the seed. Raises ValueError for an unknown name."""
    maker = _MAKERS.get(name)
    if maker is None:
        raise ValueError(f"no world {name!r}; there are {', '.join(NAMES)}")
    return maker(seed, WorldOptions(speed, hold, movers, people, tour, jumps))
