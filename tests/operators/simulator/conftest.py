"""Worlds, their light and their patterns are the same for the same parameters, so the simulator's tests share them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from operators.simulator.rendering import lighting, renderer
from operators.simulator.worlds import make


@pytest.fixture(scope="session", autouse=True)
def shared_worlds() -> Iterator[None]:
    made, baked, drawn = make.make_world, lighting._bake, renderer.make_atlas
    lights: dict[Any, Any] = {}

    def bake(world: Any, vertices: Any, normals: Any, occluded: Callable[..., Any]) -> Any:
        key = id(world), vertices.tobytes(), normals.tobytes()
        if key not in lights:
            lights[key] = (
                world,
                baked(world, vertices, normals, occluded),
            )  # the world, so that its number stays its own
        return lights[key][1]

    atlas = functools.lru_cache(maxsize=32)(drawn)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make, "make_world", functools.lru_cache(maxsize=16)(made))
        patch.setattr(lighting, "_bake", bake)
        patch.setattr(renderer, "make_atlas", lambda names, seed: atlas(tuple(names), seed))
        yield
