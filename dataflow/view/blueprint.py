"""Derives the layout of the viewer from the streams: one world, cameras with overlays, scene graph, plots, log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.api import VisualizerLike

from dataflow.graph.sections import PANELS
from dataflow.messages import Diagnostics, NavSatFix, Odometry, PointCloud, Pose
from dataflow.view.canvas import Role
from dataflow.view.drawing import plots_of, roles_of
from dataflow.view.layout import Camera, Layout
from dataflow.view.scene import SCENE, TIMELINE, VIEWER_LOG, entity_of
from dataflow.view.scores import SCORES
from dataflow.view.viewpoint import ViewerPose
from dataflow.view.visualizers.scene_tree import HEIGHT, WIDTH

_BACKGROUND = (24, 27, 33)
_PLOT_SECONDS = 10.0
_WIDE, _HIGH = (-0.08 * WIDTH, 0.92 * WIDTH), (-0.03 * HEIGHT, 1.03 * HEIGHT)

_WHOLE = rrb.VisibleTimeRanges(
    [rr.VisibleTimeRange(TIMELINE, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())]
)
"""All that was drawn up to the cursor stays in view."""

Overrides = dict[rr.encodings.EntityPath | str, VisualizerLike]
Part = rrb.View | rrb.Container


def blueprint(
    shown: Layout, *, outlook: ViewerPose | None = None, following: bool = False, scores: bool = False
) -> rrb.Blueprint:
    """The views for a layout.

    `outlook` is the view point; without it Rerun chooses. `following`: the viewer keeps up with what arrives. `scores`:
    a run's scores are there.
    """
    chosen = shown.panels or PANELS
    world = _world(shown, outlook) if "world" in chosen else None
    cameras = [_camera(camera, shown) for camera in shown.cameras] if "cameras" in chosen else []
    scene = _graphs(shown) if "scene" in chosen else []
    side = [*scene, *(_maps(shown) if "map" in chosen else []), *_tensors(shown)]
    plots = _plots(shown) if "plots" in chosen else []
    status = _status(shown) if "status" in chosen else None
    log = _log(shown) if "log" in chosen else None

    told = [name for name in _with_role(shown, "graph") if name not in shown.aside]
    words = _texts(shown) if "text" in chosen else []
    judged = [rrb.TextDocumentView(origin=SCORES, name="Scores")] if scores and "scores" in chosen else []
    if told and world is not None:
        left = _stack((world, 5), (_tabs(side), 2))
        beside = _stack((_tabs(cameras), 4), (_one_of([*words, *judged]), 4), (_tabs(plots), 2), (status, 1), (log, 1))
    else:
        left = _stack((world, 3), (_row(cameras, 3), 2))
        beside = _stack((_tabs([*side, *words, *judged]), 3), (_tabs(plots), 3), (status, 1), (log, 2))
    if left is not None and beside is not None:
        root: Part = rrb.Horizontal(left, beside, column_shares=[2, 1] if told else [7, 3])
    else:
        root = left or beside or _log(shown)
    return rrb.Blueprint(
        root,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if following else None),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _world(shown: Layout, outlook: ViewerPose | None) -> rrb.Spatial3DView | None:
    """One 3-D view of everything with a place. Overlays stay with their images; depth gives way to clouds.

    None where nothing has depth or a place: colour images alone would hang in an empty world.
    """
    clouds = shown.of_type(PointCloud)
    placed = [name for name in _with_role(shown, "space") if (name, "space") not in shown.empty]
    contents = [f"+ {entity_of(name)}/space/**" for name in placed]
    for name in _with_role(shown, "image"):
        users = [c for c in shown.cameras if name in (c.image, c.info)]
        calibrated = [c for c in users if c.info is not None]
        if not users or any(not (c.depth and clouds) for c in calibrated):
            contents.append(f"+ {entity_of(name)}")
    if not placed and not any(c.depth and c.info is not None for c in shown.cameras):
        return None
    overrides: Overrides = {f"{entity_of(name)}/space/trail": _WHOLE for name in shown.of_type(Pose, Odometry)}
    overrides |= {f"{entity_of(name)}/space/kept": _WHOLE for name in shown.kept}
    overrides |= {f"{entity_of(name)}/space": rrb.EntityBehavior(visible=False) for name in shown.aside}
    eye = None
    if outlook is not None and outlook.position is not None:
        eye = rrb.EyeControls3D(position=outlook.position, look_target=outlook.target, eye_up=outlook.up)
    return rrb.Spatial3DView(
        origin=SCENE,
        contents=[f"+ {SCENE}/**", *contents],
        name="World",
        background=_BACKGROUND,
        eye_controls=eye,
        overrides=overrides,
    )


def _camera(camera: Camera, shown: Layout) -> rrb.Spatial2DView:
    """One image with what is drawn over it."""
    overlays = [f"+ {entity_of(name)}/overlay/**" for name in camera.overlays]
    return rrb.Spatial2DView(
        origin=entity_of(camera.image),
        contents=[f"+ {entity_of(camera.image)}", f"+ {entity_of(camera.image)}/scale/**", *overlays],
        name=_short(camera.image, shown),
        background=_BACKGROUND,
    )


def _graphs(shown: Layout) -> list[Part]:
    kinds = rrb.archetypes
    return [
        rrb.GraphView(
            origin=f"{entity_of(name)}/graph",
            name=_titled("Scene graph", name, shown),
            visual_bounds=rrb.VisualBounds2D(x_range=_WIDE, y_range=_HIGH),
            force_link=kinds.ForceLink(enabled=False),
            force_many_body=kinds.ForceManyBody(enabled=False),
            force_position=kinds.ForcePosition(enabled=False),
            force_collision_radius=kinds.ForceCollisionRadius(enabled=False),
            force_center=kinds.ForceCenter(enabled=False),
        )
        for name in sorted(_with_role(shown, "graph"), key=lambda name: name in shown.aside)
    ]


def _texts(shown: Layout) -> list[Part]:
    """Documents, of which the newest is shown: the scene in words, scores."""
    return [
        rrb.TextDocumentView(origin=f"{entity_of(name)}/text", name=_titled("Scene", name, shown))
        for name in _with_role(shown, "text")
        if name not in shown.aside
    ]


def _maps(shown: Layout) -> list[Part]:
    names = _with_role(shown, "map")
    ways: Overrides = {f"{entity_of(name)}/map/way": _WHOLE for name in shown.of_type(NavSatFix)}
    contents = [f"+ {entity_of(name)}/map/**" for name in names]
    return [rrb.MapView(origin="/", contents=contents, name="Map", overrides=ways)] if names else []


def _tensors(shown: Layout) -> list[Part]:
    return [
        rrb.TensorView(origin=f"{entity_of(name)}/tensor", name=_short(name, shown))
        for name in _with_role(shown, "tensor")
    ]


def _plots(shown: Layout) -> list[Part]:
    """Latencies and rates of all diagnostics together; every other stream its own plot."""
    health = shown.of_type(Diagnostics)
    parts: list[Part] = []
    for name in _with_role(shown, "plot"):
        if name in health:
            continue
        entity, title, apart = entity_of(name), _short(name, shown), plots_of(shown.streams[name])
        if apart:
            drawn = [what for what in apart if (name, f"plot/{what}") not in shown.empty]
            each = [_plot(f"{title} {what}", [f"+ {entity}/plot/{what}/**"]) for what in drawn]
            parts += [rrb.Vertical(contents=each, name=title)] if each else []
        else:
            parts.append(_plot(title, [f"+ {entity}/plot/**"]))
    for kind, title in (("latency", "Latency"), ("rate", "Rates"), ("value", "Health")):
        drawn = [name for name in health if (name, f"plot/{kind}") not in shown.empty]
        parts += [_plot(title, [f"+ {entity_of(name)}/plot/{kind}/**" for name in drawn])] if drawn else []
    return parts


def _status(shown: Layout) -> Part | None:
    """A lane for everything that reports its health: green, yellow, red, grey where it is silent."""
    contents = [f"+ {entity_of(name)}/status/**" for name in _with_role(shown, "status")]
    return rrb.StateTimelineView(origin="/", contents=contents, name="Status") if contents else None


def _plot(name: str, contents: Sequence[str]) -> rrb.TimeSeriesView:
    near = rr.TimeRangeBoundary.cursor_relative
    window = rr.VisibleTimeRange(TIMELINE, start=near(seconds=-_PLOT_SECONDS), end=near())
    return rrb.TimeSeriesView(origin="/", contents=list(contents), name=name, time_ranges=[window])


def _log(shown: Layout) -> rrb.TextLogView:
    contents = [f"+ {entity_of(name)}/log" for name in _with_role(shown, "log")]
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="/", contents=[f"+ {VIEWER_LOG}", *contents], name="Log", columns=columns)


def _with_role(shown: Layout, role: Role) -> list[str]:
    return [name for name, type_ in shown.streams.items() if role in roles_of(type_)]


def _stack(*parts: tuple[Part | None, float]) -> Part | None:
    """Those that there are, one above the other, with their shares of the height."""
    there = [(part, share) for part, share in parts if part is not None]
    if len(there) <= 1:
        return there[0][0] if there else None
    return rrb.Vertical(contents=[part for part, _ in there], row_shares=[share for _, share in there])


def _row(parts: Sequence[Part], columns: int) -> Part | None:
    """Side by side; more than fit in a row go into the next."""
    if len(parts) <= 1:
        return parts[0] if parts else None
    if len(parts) <= columns:
        return rrb.Horizontal(contents=parts)
    return rrb.Grid(contents=parts, grid_columns=int(np.ceil(np.sqrt(len(parts)))))


def _tabs(parts: Sequence[Part]) -> Part | None:
    """One of several at a time, or, of two, both."""
    return rrb.Vertical(contents=parts) if len(parts) == 2 else _one_of(parts)


def _one_of(parts: Sequence[Part]) -> Part | None:
    """One at a time, the first at first."""
    if len(parts) <= 1:
        return parts[0] if parts else None
    return rrb.Tabs(contents=parts, active_tab=0)


def _titled(title: str, stream: str, shown: Layout) -> str:
    """A title for the only stream of its kind that is not put aside; with the stream's name where there are several."""
    rivals = [name for name in shown.of_type(shown.streams[stream]) if name not in shown.aside]
    return title if rivals == [stream] else f"{title} {_short(stream, shown)}"


def _short(stream: str, shown: Layout) -> str:
    """The stream's name without what all names begin with."""
    chunks = [name.split("/") for name in shown.streams]
    common = 0
    while all(len(c) > common + 2 and c[common] == chunks[0][common] for c in chunks):
        common += 1
    return "/".join(stream.split("/")[common:])
