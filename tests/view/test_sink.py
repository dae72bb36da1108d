"""A sink takes what it is given without waiting, survives what it cannot draw, and saves what a viewer needs."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dataflow.graph.model import Bundle, Graph, Live, Node
from dataflow.graph.sections import Record, View
from dataflow.messages import (
    CameraInfo,
    DepthImage,
    Detections2D,
    Diagnostics,
    Image,
    Imu,
    LaserScan,
    Message,
    Pose,
    SceneGraph,
    Tracks,
    Transforms,
    array,
)
from dataflow.operator import FINDING
from dataflow.recording import Recording, RecordingWriter
from dataflow.view.layout import layout

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    import rerun.blueprint as rrb
    from rrd_rows import at, blueprint_rows, rows

    from dataflow.view import (
        Connect,
        Save,
        Serve,
        Spawn,
        ViewerError,
        ViewerSink,
        from_recording,
        parse_target,
        visualizer,
    )
    from dataflow.view.backlog import Bounds
    from dataflow.view.blueprint import blueprint
    from dataflow.view.scores import scores_of

STAMP = 1_700_000_000_000_000_000
SECOND = 1_000_000_000


class Unwilling(Message, schema="test.view.Unwilling"):
    """A message whose visualiser fails."""


class Slow(Message, schema="test.view.Slow"):
    """A message whose visualiser waits."""

    data: np.ndarray = array("uint8", "N", "ballast")


gate = threading.Event()


def _unwilling(canvas: object, message: Unwilling) -> None:
    raise RuntimeError(f"no, not {message.stamp}")


def _slow(canvas: object, message: Slow) -> None:
    assert gate.wait(30)


@pytest.fixture(scope="module", autouse=True)
def _visualizers(_late_imports: None) -> None:
    visualizer(Unwilling, "log")(_unwilling)
    visualizer(Slow, "log")(_slow)


def imu(stamp: int) -> Imu:
    return Imu(stamp=stamp, frame="imu", angular_velocity=[0, 0, 1], linear_acceleration=[0, 0, 9.81])


def pose(stamp: int, x: float = 0.0) -> Pose:
    return Pose(stamp=stamp, frame="world", child_frame="optical", position=[x, 0, 0], orientation=[0, 0, 0, 1])


def scan(stamp: int) -> LaserScan:
    return LaserScan(stamp=stamp, frame="lidar", angle_min=0.0, angle_max=0.1, ranges=[1.0, 2.0])


def test_a_saved_file_holds_the_messages_at_their_stamps(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    with ViewerSink(Save(path)) as sink:
        sink.open({"r/imu/data": Imu})
        for t in range(20):
            assert sink.log("r/imu/data", imu(STAMP + t), wait=10.0)
    assert sink.statistics().drawn == 20
    found = at(rows(path), "/r/imu/data/plot/gyroscope", "Scalars:scalars")
    assert [row.stamp for row in found] == [STAMP + t for t in range(20)]


def test_a_visualizer_that_fails_is_reported_once_and_counted(tmp_path: Path) -> None:
    path, said = tmp_path / "a.rrd", []
    sink = ViewerSink(Save(path), report=said.append)
    sink.open({"bad": Unwilling, "worse": Unwilling, "imu": Imu})
    for t in range(5):
        sink.log("bad", Unwilling(stamp=t), wait=10.0)
        sink.log("imu", imu(t), wait=10.0)
    sink.log("worse", Unwilling(stamp=0), wait=10.0)
    assert sink.close()
    assert (sink.statistics().failed, sink.statistics().drawn) == (6, 5)
    assert said == ["cannot draw bad: RuntimeError: no, not 0", "cannot draw worse: RuntimeError: no, not 0"]
    assert len(at(rows(path), "/imu/plot/gyroscope", "Scalars:scalars")) == 5


def test_a_slow_viewer_costs_the_caller_nothing_and_the_oldest_messages(tmp_path: Path) -> None:
    gate.clear()
    said: list[str] = []
    sink = ViewerSink(Save(tmp_path / "a.rrd"), report=said.append, bounds=Bounds(messages=10, bytes=1000))
    sink.open({"slow": Slow, "imu": Imu})
    sink.log("slow", Slow(stamp=0, data=np.zeros(1, np.uint8)))
    deadline = time.monotonic() + 10
    while sink.backlog() and time.monotonic() < deadline:
        time.sleep(0.001)
    began = time.monotonic()
    for t in range(1000):
        sink.log("imu", imu(t))
    assert time.monotonic() - began < 5.0
    assert sink.backlog() == 10
    assert sink.statistics().dropped == 990
    assert len(said) == 1
    gate.set()
    assert sink.close()
    stamps = [row.stamp for row in at(rows(tmp_path / "a.rrd"), "/imu/plot/gyroscope", "Scalars:scalars")]
    assert stamps == list(range(990, 1000))


def test_closing_a_stalled_viewer_is_bounded(tmp_path: Path) -> None:
    gate.clear()
    said: list[str] = []
    sink = ViewerSink(Save(tmp_path / "a.rrd"), report=said.append)
    sink.open({"slow": Slow})
    sink.log("slow", Slow(stamp=0, data=np.zeros(1, np.uint8)))
    began = time.monotonic()
    assert not sink.close(timeout=0.2)
    assert time.monotonic() - began < 5.0
    assert "did not take everything" in said[0]
    gate.set()


def views(part: rrb.Blueprint | rrb.Container | rrb.View) -> list[tuple[str, str]]:
    """(kind, name) of every view in a blueprint."""
    if isinstance(part, rrb.Blueprint):
        part = part.root_container
    if isinstance(part, rrb.View):
        return [(str(part.class_identifier), str(part.name))]
    return [view for inner in part.contents for view in views(inner)]


STREAMS = {
    "r/camera/image": Image,
    "r/camera/depth": DepthImage,
    "r/camera/info": CameraInfo,
    "r/detector/boxes": Detections2D,
    "r/odometry/pose": Pose,
    "r/scene/graph": SceneGraph,
    "r/imu/data": Imu,
    "r/monitor/health": Diagnostics,
}


def test_a_blueprint_has_a_view_for_everything_there_is_and_no_other() -> None:
    assert views(blueprint(layout(STREAMS))) == [
        ("3D", "World"),
        ("Graph", "Scene graph"),
        ("2D", "camera/image"),
        ("2D", "camera/depth"),
        ("TextDocument", "Scene"),
        ("TimeSeries", "imu/data orientation"),
        ("TimeSeries", "imu/data gyroscope"),
        ("TimeSeries", "imu/data accelerometer"),
        ("TimeSeries", "Latency"),
        ("TimeSeries", "Rates"),
        ("TimeSeries", "Health"),
        ("StateTimeline", "Status"),
        ("TextLog", "Log"),
    ]
    imu_alone = views(blueprint(layout({"r/imu/data": Imu})))
    assert imu_alone[-1] == ("TextLog", "Log")
    assert ("3D", "World") not in imu_alone


def test_there_is_no_world_where_nothing_has_depth_or_a_place() -> None:
    flat = {"r/camera/image": Image, "r/camera/info": CameraInfo, "r/detector/boxes": Detections2D}

    assert ("3D", "World") not in views(blueprint(layout(flat)))
    assert ("3D", "World") in views(blueprint(layout({**flat, "r/camera/depth": DepthImage})))
    assert ("3D", "World") in views(blueprint(layout({**flat, "r/odometry/pose": Pose})))


def test_a_camera_view_shows_its_overlays_and_the_world_does_not() -> None:
    def contents(name: str, part: rrb.Container | rrb.View) -> list[str]:
        if isinstance(part, rrb.View):
            return list(part.contents) if part.name == name else []
        return [line for inner in part.contents for line in contents(name, inner)]

    root = blueprint(layout(STREAMS)).root_container
    assert contents("camera/image", root) == [
        "+ /r/camera/image",
        "+ /r/camera/image/scale/**",
        "+ /r/detector/boxes/overlay/**",
    ]
    assert "+ /r/odometry/pose/space/**" in contents("World", root)
    assert not any("detector" in line for line in contents("World", root))


@pytest.mark.parametrize("optical_world", [True, False])
def test_the_viewer_finds_out_which_way_is_up(optical_world: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    sink = ViewerSink(Save(path))
    sink.open({"c/info": CameraInfo, "c/truth": Pose}, static=["c/info"])
    info = CameraInfo.from_intrinsics(stamp=0, frame="optical", width=64, height=48, fx=50, fy=50, cx=32, cy=24)
    sink.log("c/info", info)
    turn = [0, 0, 0, 1] if optical_world else [-0.5, 0.5, -0.5, 0.5]
    for t in range(3):
        sink.log("c/truth", pose(STAMP + t * SECOND).replace(orientation=turn))
    assert sink.close()
    up = at(rows(path), "/scene", "ViewCoordinates:xyz")[-1].values[0]
    assert up == ([3, 2, 5] if optical_world else [3, 5, 1])  # right, down, forward; or right, forward, up
    (eye,) = [row.values[0] for row in blueprint_rows(path) if row.component == "EyeControls3D:position"]
    assert (eye[1] < 0 and eye[2] < 0) if optical_world else (eye[2] > 0 and eye[0] < 0)  # above and behind


@pytest.mark.parametrize("late", [False, True])
def test_a_stream_gets_its_view_with_its_first_message(late: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    pixels = np.zeros((4, 4, 3), np.uint8)
    with ViewerSink(Save(path)) as sink:
        sink.open({"r/front/image": Image, "r/rear/image": Image})
        for t in range(4):
            sink.log("r/front/image", Image(stamp=STAMP + t * SECOND, frame="front", data=pixels))
        if late:
            sink.log("r/rear/image", Image(stamp=STAMP + 4 * SECOND, frame="rear", data=pixels))
    named = {row.values[0] for row in blueprint_rows(path) if row.component == "ViewBlueprint:display_name"}
    assert "front/image" in named
    assert ("rear/image" in named) == late


@pytest.mark.parametrize("late", [False, True])
def test_curves_get_their_view_when_they_are_first_drawn(late: bool, tmp_path: Path) -> None:
    path, oriented = tmp_path / "a.rrd", imu(STAMP + 1).replace(orientation=[0, 0, 0, 1])
    with ViewerSink(Save(path)) as sink:
        sink.open({"r/imu/data": Imu})
        assert sink.log("r/imu/data", imu(STAMP), wait=10.0)
        if late:
            assert sink.log("r/imu/data", oriented, wait=10.0)
    named = {row.values[0] for row in blueprint_rows(path) if row.component == "ViewBlueprint:display_name"}
    assert "imu/data gyroscope" in named
    assert ("imu/data orientation" in named) == late


@pytest.mark.parametrize("placed", [False, True])
def test_tracks_without_places_and_a_status_without_figures_get_no_view(placed: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    one = {"ids": [1], "states": [1], "scores": [1], "class_ids": [0], "ages": [3], "unseen": [0]}
    tracks = Tracks(stamp=STAMP, frame="c", boxes=[[0, 0, 2, 2]], **one)
    status = Diagnostics(stamp=STAMP, names=["n"], levels=[0], messages=["ok"])
    if placed:
        tracks = tracks.replace(positions=[[1, 0, 0]])
        status = status.replace(keys=("rate",), values=("10 Hz",), owners=[0])
    with ViewerSink(Save(path)) as sink:
        sink.open({"r/c/image": Image, "r/t/tracks": Tracks, "r/t/status": Diagnostics})
        sink.log("r/c/image", Image(stamp=STAMP, frame="c", data=np.zeros((4, 4, 3), np.uint8)), wait=10.0)
        sink.log("r/t/tracks", tracks, wait=10.0)
        sink.log("r/t/status", status, wait=10.0)
    named = {row.values[0] for row in blueprint_rows(path) if row.component == "ViewBlueprint:display_name"}
    assert {"c/image", "Status"} <= named
    assert ("World" in named, "Rates" in named) == (placed, placed)
    assert not {"Latency", "Health"} & named


def test_hidden_and_unknown_streams_are_passed_over(tmp_path: Path) -> None:
    with ViewerSink(Save(tmp_path / "a.rrd")) as sink:
        with pytest.raises(ViewerError, match="not open"):
            sink.log("imu", imu(0))
        sink.open({"imu": Imu})
        assert not sink.log("other", imu(0))


def test_a_recording_is_played_with_its_static_streams_whole(tmp_path: Path) -> None:
    info = CameraInfo.from_intrinsics(stamp=5, frame="optical", width=64, height=48, fx=50, fy=50, cx=32, cy=24)
    with RecordingWriter(tmp_path / "a.mcap", metadata={}) as writer:
        writer.add_stream("r/c/info", CameraInfo, static=True)
        writer.add_stream("r/c/truth", Pose)
        writer.write("r/c/info", info, seq=0)
        for t in range(10):
            writer.write("r/c/truth", pose(STAMP + t * SECOND, float(t)), seq=t)
    with Recording(tmp_path / "a.mcap") as recording, ViewerSink(Save(tmp_path / "a.rrd")) as sink:
        assert from_recording(recording, sink, start=STAMP + 3 * SECOND, end=STAMP + 5 * SECOND) == 4
    found = rows(tmp_path / "a.rrd")
    assert [row.stamp for row in at(found, "/r/c/info", "Pinhole:resolution")] == [None]
    assert [r.stamp for r in at(found, "/r/c/truth/space/axes", "Arrows3D:vectors")] == [
        STAMP + t * SECOND for t in (3, 4, 5)
    ]


@pytest.mark.parametrize("by_graph", [True, False])
def test_a_stream_that_is_not_shown_places_its_frame_all_the_same(by_graph: bool, tmp_path: Path) -> None:
    path, nothing = tmp_path / "a.rrd", Graph("g", "r", {}, {}, Record(()), Bundle("g.yaml", {"g.yaml": ""}))
    made = replace(nothing, view=View(hide=("odometry", "frames")))
    with ViewerSink(Save(path)) as sink:
        sink.open(
            {"odometry": Pose, "frames": Transforms, "scan": LaserScan},
            made if by_graph else nothing,
            static=["frames"],
            hidden=() if by_graph else ["odometry", "frames"],
        )
        frames = Transforms(
            stamp=STAMP,
            frames=("optical",),
            child_frames=("lidar",),
            translations=[[0, 0, 0.5]],
            rotations=[[0, 0, 0, 1]],
        )
        assert sink.log("frames", frames)
        for k in range(3):
            assert sink.log("odometry", pose(STAMP + k, 2.0 + k))
            sink.log("scan", scan(STAMP + k))
    found = rows(path)
    placed = {row.stamp: row.values for row in at(found, "/frames/optical", "Transform3D:translation")}
    assert placed[STAMP + 2] == [[4.0, 0.0, 0.0]]
    assert at(found, "/frames/lidar", "Transform3D:translation")[0].values == [[0.0, 0.0, 0.5]]
    assert not [row for row in found if row.entity.startswith(("/odometry", "/frames/space"))]


def test_hidden_stream_neither_places_nor_adds_frames(tmp_path: Path) -> None:
    def placed_by(frame: str, k: int, x: float) -> Pose:
        return Pose(stamp=STAMP + k, frame=frame, child_frame="lidar", position=[x, 0, 0], orientation=[0, 0, 0, 1])

    path = tmp_path / "a.rrd"
    with ViewerSink(Save(path)) as sink:
        sink.open({"shown": Pose, "wheels": Pose, "scan": LaserScan}, hidden=["wheels"])
        for k in range(3):
            sink.log("wheels", placed_by("wheel_odom", k, 9.0))
            sink.log("scan", scan(STAMP + k))
            sink.log("shown", placed_by("world", k, 2.0))
    found = rows(path)
    assert {row.values[0] for row in at(found, "/frames/lidar", "Transform3D:parent_frame")} == {"world"}
    assert not [row for row in found if row.entity == "/frames/wheel_odom"]


def test_scores_of_operators_without_outputs_have_a_panel(tmp_path: Path) -> None:
    judge, maker = (
        Node(name, "nowhere:Nothing", {}, {}, outputs, Live("newest", 1, {}))
        for name, outputs in (("trajectory_score", {}), ("odometry", {"pose": "r/odometry/pose"}))
    )
    made = Graph("g", "r", {n.name: n for n in (judge, maker)}, {}, Record(()), Bundle("g.yaml", {"g.yaml": ""}))
    path = tmp_path / "a.rrd"
    with ViewerSink(Save(path)) as sink:
        sink.open({"r/odometry/pose": Pose}, made)
        sink.log("r/odometry/pose", pose(STAMP))
        sink.scores({"trajectory_score": {"ate_rmse_m": 0.01269, "matched": 1210}, "odometry": {"frames": 3}})
    (text,) = (row.values[0] for row in at(rows(path), "/viewer/scores", "TextDocument:text"))
    assert "| ate rmse | 0.01269 m |" in text
    assert "| matched | 1,210 |" in text
    assert "frames" not in text
    assert "Scores" in [row.values[0] for row in blueprint_rows(path) if row.component.endswith("display_name")]


def test_findings_precede_the_scores() -> None:
    maker, judge = (
        Node(name, "nowhere:Nothing", {}, {}, outputs, Live("newest", 1, {}))
        for name, outputs in (("calibration", {"status": "r/calibration/status"}), ("score", {}))
    )
    made = Graph("g", "r", {n.name: n for n in (judge, maker)}, {}, Record(()), Bundle("g.yaml", {"g.yaml": ""}))
    told = {"score": {"ate_rmse_m": 0.1}, "calibration": {"pairs": 3, FINDING: "colour lies beside depth"}}
    assert list(scores_of(told, made).items()) == [
        ("calibration", {FINDING: "colour lies beside depth"}),
        ("score", {"ate_rmse_m": 0.1}),
    ]


def test_targets_are_named_in_words() -> None:
    assert parse_target("spawn") == Spawn()
    assert parse_target("serve") == Serve()
    assert parse_target("rerun+http://10.0.0.2:9876/proxy") == Connect("rerun+http://10.0.0.2:9876/proxy")
    assert parse_target("out/run.rrd") == Save(Path("out/run.rrd"))
    with pytest.raises(ViewerError, match=r"expected spawn, serve, .*\.rrd"):
        parse_target("browser")


def test_unreachable_viewer_is_refused_on_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ViewerError, match="there is no folder"):
        ViewerSink(Save(tmp_path / "none" / "a.rrd")).open({"imu": Imu})
    with pytest.raises(ViewerError, match=r"no viewer listens on 127\.0\.0\.1:1\b"):
        ViewerSink(Connect("rerun+http://127.0.0.1:1/proxy")).open({"imu": Imu})
    with pytest.raises(ViewerError, match="expected rerun"):
        ViewerSink(Connect("rerun+http://127.0.0.1:9876")).open({"imu": Imu})
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match="no display"):
        ViewerSink(Spawn()).open({"imu": Imu})


def test_a_layout_that_was_saved_takes_the_place_of_the_derived_one(tmp_path: Path) -> None:
    saved = tmp_path / "mine.rbl"
    rrb.Blueprint(rrb.TextLogView(origin="/", name="Only this")).save("g", str(saved))

    def opened(layout: str) -> tuple[list[str], list[str]]:
        made = Graph("g", "r", {}, {}, Record(()), Bundle("g.yaml", {"g.yaml": ""}), view=View(layout=layout))
        said: list[str] = []
        path = tmp_path / "a.rrd"
        with ViewerSink(Save(path), report=said.append) as sink:
            sink.open({"c/truth": Pose}, made)
            sink.log("c/truth", pose(STAMP))
        return [row.values[0] for row in blueprint_rows(path) if row.component.endswith("display_name")], said

    names, said = opened(str(saved))
    assert (names, said) == (["Only this"], [])
    names, said = opened(str(tmp_path / "lost.rbl"))
    assert "World" in names
    assert "lost.rbl" in said[0]
