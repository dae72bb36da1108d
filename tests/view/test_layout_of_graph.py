"""With a graph, what was made from what decides, not names; and what the graph hides is not shown."""

from __future__ import annotations

from dataclasses import replace

from dataflow.graph.model import Bundle, Graph, Live, Node, Stream
from dataflow.graph.sections import Record, View
from dataflow.messages import (
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Detections2D,
    Image,
    Message,
    Odometry,
    SceneGraph,
)
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


def linked(types: dict[str, type[Message]], nodes: list[Node], view: View) -> Graph:
    streams = [
        Stream(name, n.name, port, (types[name].SCHEMA,), static=port == "info")
        for n in nodes
        for port, name in n.outputs.items()
    ]
    by_name = {n.name: n for n in nodes}
    made = {s.name: s for s in streams}
    return Graph("g", "r", by_name, made, Record(()), Bundle("g.yaml", {"g.yaml": ""}), view=view)


def graph(hide: tuple[str, ...] = ()) -> Graph:
    nodes = [
        node("left", {}, "image", "info"),
        node("right", {}, "image", "info"),
        node("gray", {"image": "r/right/image"}, "image"),
        node("left_detector", {"image": "r/gray/image"}, "boxes"),
        node("monodepth", {"image": "r/right/image"}, "depth"),
    ]
    return linked(TYPES, nodes, View(hide))


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


def test_of_hidden_streams_those_that_place_frames_are_taken_for_that() -> None:
    types = TYPES | {"r/odometry/odometry": Odometry}
    hidden = ("r/left/image", "r/odometry/odometry")
    assert layout(types, graph(hide=hidden)).placing == {"r/odometry/odometry"}
    assert layout(TYPES, graph(), hidden=hidden[:1]).streams.keys() == TYPES.keys() - {"r/left/image"}


def test_an_image_and_what_only_decodes_it_are_shown_once_with_overlays_on_the_one_that_stays() -> None:
    types: dict[str, type[Message]] = {
        "r/camera/jpeg": CompressedImage,
        "r/camera/png": CompressedDepth,
        "r/color/image": Image,
        "r/depth/depth": DepthImage,
        "r/small/image": Image,
        "r/detector/boxes": Detections2D,
    }
    nodes = [
        node("camera", {}, "jpeg", "png"),
        node("color", {"compressed": "r/camera/jpeg"}, "image"),
        node("depth", {"compressed": "r/camera/png"}, "depth"),
        node("small", {"image": "r/color/image"}, "image"),
        node("detector", {"image": "r/color/image"}, "boxes"),
    ]
    shown = layout(types, linked(types, nodes, View()))
    cameras = {camera.image: camera for camera in shown.cameras}
    assert set(cameras) == {"r/camera/jpeg", "r/camera/png", "r/small/image"}
    assert cameras["r/camera/jpeg"].overlays == ("r/detector/boxes",)
    without = {name: type_ for name, type_ in types.items() if name != "r/camera/jpeg"}
    assert "r/color/image" in layout(without, linked(types, nodes, View())).streams  # nothing else shows it


def test_ground_truth_is_shown_aside_of_estimates() -> None:
    types: dict[str, type[Message]] = {
        "r/robot/scene": SceneGraph,
        "r/robot/boxes": Boxes3D,
        "r/lifter/boxes": Boxes3D,
        "r/builder/scene": SceneGraph,
    }
    robot = replace(node("robot", {}, "scene", "boxes"), source=True)
    nodes = [robot, node("lifter", {}, "boxes"), node("builder", {"boxes": "r/lifter/boxes"}, "scene")]
    made = linked(types, nodes, View(panels=("world", "log")))
    assert layout(types, made).aside == {"r/robot/scene", "r/robot/boxes"}
    only_true = {name: type_ for name, type_ in types.items() if name.startswith("r/robot")}
    assert layout(only_true, made).aside == {"r/robot/scene"}, "true boxes are all there is to see"
    assert layout(types, made).panels == ("world", "log")


def test_a_plot_is_no_image_of_a_camera_and_has_no_calibration() -> None:
    types: dict[str, type[Message]] = {
        "r/robot/image": Image,
        "r/robot/info": CameraInfo,
        "r/odometry/odometry": Odometry,
        "r/plots/picture": Image,
        "r/blurred/image": Image,
    }
    nodes = [
        node("robot", {}, "image", "info"),
        node("odometry", {"image": "r/robot/image"}, "odometry"),
        node("plots", {"estimate": "r/odometry/odometry"}, "picture"),
        node("blurred", {"image": "r/robot/image"}, "image"),
    ]

    shown = layout(types, linked(types, nodes, View()))

    assert {camera.image: camera.info for camera in shown.cameras} == {
        "r/robot/image": "r/robot/info",
        "r/plots/picture": None,
        "r/blurred/image": "r/robot/info",
    }
    assert shown.planes["r/plots/picture"] != shown.planes["r/robot/image"]
