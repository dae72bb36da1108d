"""Tracks of people as the shipped networks, depth and the map give them, to train the activity network on.

    python benchmarks/sensed_people.py CACHE OUT --seeds 42000 42001 ... [--every 1 2]

Drives through worlds as sensed_worlds.py does, which keeps what the networks gave in CACHE, and writes the tracks of
each to OUT: features, what the agent did, whether it was in view. `dataflow train activity --sensed OUT` takes them.
With `--every 1 2` it does so for all images, and for every second one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from scene_graph import acts
from sensed_worlds import World, ids_in_view, mapped, sensed

from operators.recognition.activity.sensed_people import SensedTrack, sensed_tracks, write_tracks
from operators.simulator.classes import ACTIVITIES


def tracks_of(world: World, every: int) -> list[SensedTrack]:
    frames = world.frames[::every]
    made = mapped(World(world.name, world.image_info, world.extrinsics, frames))
    return sensed_tracks(
        [each.nodes for each in made],
        [frame.base for frame in frames],
        [frame.scene for frame in frames],
        [acts(frame.activities) for frame in frames],
        [ids_in_view(frame.objects, 0.3) for frame in frames],
        ACTIVITIES,
        [each.objects for each in made],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--every", type=int, nargs="+", default=[1], help="take every so many images")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for seed in options.seeds:
        for world in sensed(range(seed, seed + 1), options.cache):
            tracks = [track for every in options.every for track in tracks_of(world, every)]
            write_tracks(options.out / f"{seed}.npz", tracks)
            print(f"{world.name}: {len(tracks)} tracks, {sum(int(t.plain.sum()) for t in tracks)} moments in view")


if __name__ == "__main__":
    main()
