"""A file shows an image in each step of event time, with what was made from it."""

from __future__ import annotations

import random
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dataflow.graph.model import Bundle, Graph
from dataflow.graph.sections import Record, View, view_from_json, view_to_json
from dataflow.messages import Detections2D, Image, Imu, Message, PointCloud, Transforms
from dataflow.view.layout import layout
from dataflow.view.pacing import Pace

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    from rrd_rows import at, rows

    from dataflow.view import Save, ViewerSink
    from dataflow.view.scene import ViewOptions

STAMP = 1_700_000_000_000_000_000
MS = 1_000_000


def image(ms: int) -> Image:
    return Image(stamp=STAMP + ms * MS, frame="optical", data=np.full((4, 6), ms % 256, np.uint8))


def boxes(ms: int) -> Detections2D:
    return Detections2D(
        stamp=STAMP + ms * MS,
        frame="optical",
        boxes=[[0, 0, 3, 3]],
        scores=[0.5],
        class_ids=[1],
        class_names=["a", "b"],
        width=6,
        height=4,
    )


def imu(ms: int) -> Imu:
    return Imu(stamp=STAMP + ms * MS, frame="imu", angular_velocity=[0, 0, 1], linear_acceleration=[0, 0, 9.8])


def taken(pace: Pace, messages: list[tuple[str, Message]]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for stream, message in messages:
        if pace.takes(stream, message):
            found.setdefault(stream, []).append((message.stamp - STAMP) // MS)
    return found


def test_a_choice_is_independent_of_the_order_in_which_streams_arrive() -> None:
    streams = {"camera/image": [image(ms) for ms in range(0, 1000, 33)],
               "detector/boxes": [boxes(ms) for ms in range(0, 1000, 33)]}  # fmt: skip
    generator, choices = random.Random(3), []
    for _ in range(20):
        waiting = {name: list(messages) for name, messages in streams.items()}
        order: list[tuple[str, Message]] = []
        while left := [name for name, messages in waiting.items() if messages]:
            name = generator.choice(left)
            order.append((name, waiting[name].pop(0)))
        choices.append(taken(Pace(200 * MS, frozenset(streams)), order))
    assert all(choice == choices[0] for choice in choices)
    assert choices[0]["camera/image"] == choices[0]["detector/boxes"] == [0, 231, 429, 627, 825]


def test_the_last_of_a_stream_is_drawn() -> None:
    pace = Pace(200 * MS, {"a", "b"})
    assert taken(pace, [("a", image(ms)) for ms in (0, 50, 100)]) == {"a": [0]}
    assert taken(pace, [("b", image(ms)) for ms in (50, 210)]) == {"b": [50, 210]}
    assert [(stream, message.stamp) for stream, message in pace.rest()] == [("a", STAMP + 100 * MS)]
    assert not list(pace.rest())


def test_only_images_overlays_and_clouds_that_do_not_stay_are_chosen_from() -> None:
    graph = Graph("g", "g", {}, {}, Record(()), Bundle("g.yaml", {"g.yaml": ""}), view=View(keep=("s/map",)))
    types: dict[str, type[Message]] = {
        "c/image": Image, "d/boxes": Detections2D, "s/points": PointCloud, "s/map": PointCloud, "i/imu": Imu,
        "f/frames": Transforms, "c/still": Image,
    }  # fmt: skip
    assert layout(types, graph, static=["c/still"]).pace(1).streams == {"c/image", "d/boxes", "s/points"}


def _drawn(path: Path, options: ViewOptions | None = None, view: View | None = None) -> dict[str, int]:
    graph = view and Graph("g", "g", {}, {}, Record(()), Bundle("g.yaml", {"g.yaml": ""}), view=view)
    with ViewerSink(Save(path), options=options) as sink:
        sink.open({"c/image": Image, "d/boxes": Detections2D, "i/imu": Imu}, graph)
        for ms in range(0, 1000, 50):
            for stream, message in (("c/image", image(ms)), ("d/boxes", boxes(ms)), ("i/imu", imu(ms))):
                assert sink.log(stream, message, wait=30)
    found = rows(path)
    blobs = [row.stamp for row in at(found, "/c/image", "EncodedImage:blob")]
    overlays = [row.stamp for row in at(found, "/d/boxes/overlay", "Boxes2D:half_sizes")]
    assert blobs == overlays
    counts = {"images": len(blobs), "imu": len(at(found, "/i/imu/plot/gyroscope", "Scalars:scalars"))}
    return counts | {"passed": sink.statistics().passed}


@pytest.mark.parametrize(
    ("options", "view", "images"),
    [
        (None, None, 6),  # five in a second, and the last
        (None, View(every=500 * MS), 3),  # as the graph says
        (None, View(every=0), 20),  # every message
        ({}, None, 20),  # more than a file has by itself
        ({"image_step": 100 * MS}, View(every=0), 11),  # options go before the graph
    ],
)
def test_a_file_has_an_image_in_each_step(
    tmp_path: Path, options: dict[str, int] | None, view: View | None, images: int
) -> None:
    chosen = None if options is None else ViewOptions(**options)
    assert _drawn(tmp_path / "f.rrd", chosen, view) == {"images": images, "imu": 20, "passed": 2 * (20 - images)}


def test_a_graph_that_does_not_choose_a_step_is_written_as_before() -> None:
    assert "every" not in view_to_json(View())
    assert view_from_json(view_to_json(View(every=5))) == View(every=5)
    assert view_from_json({"hide": ["a"]}) == View(hide=("a",))


def test_a_negative_step_is_refused() -> None:
    with pytest.raises(ValueError, match="image_step must be 0 ns or more, got -1"):
        ViewOptions(image_step=-1)
