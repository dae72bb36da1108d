"""With a graph, what was made from what decides, not names; and what the graph hides is not shown."""

from __future__ import annotations

from dataflow.graph.model import Bundle, Graph, Live, Node, Record, Stream, View
from dataflow.messages import CameraInfo, DepthImage, Detections2D, Image
from dataflow.view.layout import layout

TYPES = {
    "r/left/image": Image,
    "r/left/info": CameraInfo,
    "r/right/image": Image,
    "r/right/info": CameraInfo,
    "r/gray/image": Image,
    "r/left_detector/boxes": Detections2D,
    "r/monodepth/depth": DepthImage,
}


def node(name: str, inputs: dict[str, str], *outputs: str) -> Node:
    made = {port: f"r/{name}/{port}" for port in outputs}
    taken = {port: (stream,) for port, stream in inputs.items()}
    return Node(name, "nowhere:Nothing", {}, taken, made, Live("newest", 1, {}))


def graph(hide: tuple[str, ...] = ()) -> Graph:
    nodes = [
        node("left", {}, "image", "info"),
        node("right", {}, "image", "info"),
        node("gray", {"image": "r/right/image"}, "image"),
        node("left_detector", {"image": "r/gray/image"}, "boxes"),
        node("monodepth", {"image": "r/right/image"}, "depth"),
    ]
    streams = [
        Stream(name, n.name, port, (TYPES[name].SCHEMA,), static=port == "info")
        for n in nodes
        for port, name in n.outputs.items()
    ]
    by_name = {n.name: n for n in nodes}
    made = {s.name: s for s in streams}
    return Graph("g", "r", by_name, made, Record(()), Bundle("g.yaml", {"g.yaml": ""}), view=View(hide))


def test_overlays_and_derived_images_follow_the_graph_against_their_names() -> None:
    shown = layout(TYPES, graph())
    cameras = {camera.image: camera for camera in shown.cameras}
    assert cameras["r/gray/image"].overlays == ("r/left_detector/boxes",)
    assert cameras["r/left/image"].overlays == ()
    assert cameras["r/gray/image"].info == "r/right/info"
    assert cameras["r/monodepth/depth"].info == "r/right/info"
    assert shown.static == {"r/left/info", "r/right/info"}


def test_hidden_streams_are_not_shown() -> None:
    shown = layout(TYPES, graph(hide=("r/left/image", "r/left/info")))
    assert "r/left/image" not in shown.streams
    assert {camera.image for camera in shown.cameras} == {"r/right/image", "r/gray/image", "r/monodepth/depth"}
