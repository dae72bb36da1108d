"""Derives the layout of the viewer from the streams: one world, cameras with overlays, scene graph, plots, log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.api import VisualizerLike

from dataflow.graph.model import Graph
from dataflow.graph.sections import PANELS
from dataflow.messages import Diagnostics, Message, NavSatFix, Odometry, PointCloud, Pose
from dataflow.view.canvas import Role, plots_of, roles_of
from dataflow.view.layout import Camera, Layout, layout
from dataflow.view.scene import SCENE, TIMELINE, VIEWER_LOG, Outlook, entity_of

_BACKGROUND = (24, 27, 33)
_PLOT_SECONDS = 10.0

Part = rrb.View | rrb.Container


def blueprint(
    streams: Mapping[str, type[Message]],
    graph: Graph | None = None,
    *,
    outlook: Outlook | None = None,
    following: bool = False,
) -> rrb.Blueprint:
    """The views for `streams` (name → message type), less those that the graph hides.

    `outlook` says where to look from; without it Rerun chooses. `following`: the viewer keeps up with what arrives.
    """
    return blueprint_of(layout(streams, graph), outlook=outlook, following=following)


def blueprint_of(shown: Layout, *, outlook: Outlook | None = None, following: bool = False) -> rrb.Blueprint:
    """The views for a layout."""
    chosen = shown.panels or PANELS
    world = _world(shown, outlook) if "world" in chosen else None
    cameras = [_camera(camera, shown) for camera in shown.cameras] if "cameras" in chosen else []
    scene = _graphs(shown) if "scene" in chosen else []
    side = [*scene, *(_maps(shown) if "map" in chosen else []), *_tensors(shown)]
    plots = _plots(shown) if "plots" in chosen else []
    status = _status(shown) if "status" in chosen else None
    log = _log(shown) if "log" in chosen else None

    main = [part for part in (world, _row(cameras, 3)) if part is not None]
    parts = ((_tabs(side), 3), (_tabs(plots), 3), (status, 1), (log, 2))
    column = [(part, share) for part, share in parts if part is not None]
    beside = None
    if column:
        beside = rrb.Vertical(contents=[part for part, _ in column], row_shares=[share for _, share in column])
    left = None
    if main:
        left = main[0] if len(main) == 1 else rrb.Vertical(contents=main, row_shares=[3, 2])
    if left is not None and beside is not None:
        root: Part = rrb.Horizontal(left, beside, column_shares=[7, 3])
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


def _world(shown: Layout, outlook: Outlook | None) -> rrb.Spatial3DView | None:
    """One 3-D view of everything with a place. Overlays stay with their images; depth gives way to clouds."""
    clouds = shown.of_type(PointCloud)
    contents = []
    for name in _with_role(shown, "space"):
        contents.append(f"+ {entity_of(name)}/space/**")
    for name in _with_role(shown, "image"):
        users = [c for c in shown.cameras if name in (c.image, c.info)]
        calibrated = [c for c in users if c.info is not None]
        if not users or any(not (c.depth and clouds) for c in calibrated):
            contents.append(f"+ {entity_of(name)}")
    if not contents:
        return None
    forever = rr.VisibleTimeRange(
        TIMELINE, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )
    trails: dict[rr.encodings.EntityPath | str, VisualizerLike] = {
        f"{entity_of(name)}/space/trail": rrb.VisibleTimeRanges([forever]) for name in shown.of_type(Pose, Odometry)
    }
    hidden: dict[rr.encodings.EntityPath | str, VisualizerLike] = {
        f"{entity_of(name)}/space": rrb.EntityBehavior(visible=False) for name in shown.aside
    }
    eye = None
    if outlook is not None and outlook.position is not None:
        eye = rrb.EyeControls3D(position=outlook.position, look_target=outlook.target, eye_up=outlook.up)
    return rrb.Spatial3DView(
        origin=SCENE,
        contents=[f"+ {SCENE}/**", *contents],
        name="World",
        background=_BACKGROUND,
        eye_controls=eye,
        overrides={**trails, **hidden},
    )


def _camera(camera: Camera, shown: Layout) -> rrb.Spatial2DView:
    """One image with what is drawn over it."""
    overlays = [f"+ {entity_of(name)}/overlay" for name in camera.overlays]
    return rrb.Spatial2DView(
        origin=entity_of(camera.image),
        contents=[f"+ {entity_of(camera.image)}", f"+ {entity_of(camera.image)}/scale/**", *overlays],
        name=_short(camera.image, shown),
        background=_BACKGROUND,
    )


def _graphs(shown: Layout) -> list[Part]:
    return [
        rrb.GraphView(
            origin=f"{entity_of(name)}/graph",
            name=_short(name, shown),
            force_link=rrb.archetypes.ForceLink(enabled=True, distance=70.0),
            force_many_body=rrb.archetypes.ForceManyBody(enabled=True, strength=-400.0),
            force_collision_radius=rrb.archetypes.ForceCollisionRadius(enabled=True),
        )
        for name in sorted(_with_role(shown, "graph"), key=lambda name: name in shown.aside)
    ]


def _maps(shown: Layout) -> list[Part]:
    names = _with_role(shown, "map")
    if not names:
        return []
    forever = rr.VisibleTimeRange(
        TIMELINE, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )
    return [
        rrb.MapView(
            origin="/",
            contents=[f"+ {entity_of(name)}/map/**" for name in names],
            name="Map",
            overrides={
                f"{entity_of(name)}/map/way": rrb.VisibleTimeRanges([forever]) for name in shown.of_type(NavSatFix)
            },
        )
    ]


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
            each = [_plot(f"{title} {what}", [f"+ {entity}/plot/{what}/**"]) for what in apart]
            parts.append(rrb.Vertical(contents=each, name=title))
        else:
            parts.append(_plot(title, [f"+ {entity}/plot/**"]))
    if health:
        for kind, title in (("latency", "Latency"), ("rate", "Rates"), ("value", "Health")):
            parts.append(_plot(title, [f"+ {entity_of(name)}/plot/{kind}/**" for name in health]))
    return parts


def _status(shown: Layout) -> Part | None:
    """A lane for everything that reports its health: green, yellow, red, grey where it is silent."""
    names = _with_role(shown, "status")
    if not names:
        return None
    contents = [f"+ {entity_of(name)}/status/**" for name in names]
    return rrb.StateTimelineView(origin="/", contents=contents, name="Status")


def _plot(name: str, contents: Sequence[str]) -> rrb.TimeSeriesView:
    window = rr.VisibleTimeRange(
        TIMELINE,
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-_PLOT_SECONDS),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.TimeSeriesView(origin="/", contents=list(contents), name=name, time_ranges=[window])


def _log(shown: Layout) -> rrb.TextLogView:
    contents = [f"+ {entity_of(name)}/log" for name in _with_role(shown, "log")]
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="/", contents=[f"+ {VIEWER_LOG}", *contents], name="Log", columns=columns)


def _with_role(shown: Layout, role: Role) -> list[str]:
    return [name for name, type_ in shown.streams.items() if role in roles_of(type_)]


def _row(parts: Sequence[Part], columns: int) -> Part | None:
    """Side by side; more than fit in a row go into the next."""
    if len(parts) <= 1:
        return parts[0] if parts else None
    if len(parts) <= columns:
        return rrb.Horizontal(contents=parts)
    return rrb.Grid(contents=parts, grid_columns=int(np.ceil(np.sqrt(len(parts)))))


def _tabs(parts: Sequence[Part]) -> Part | None:
    """One of several at a time, or, of two, both."""
    if not parts:
        return None
    if len(parts) <= 2:
        return parts[0] if len(parts) == 1 else rrb.Vertical(contents=parts)
    return rrb.Tabs(contents=parts, active_tab=0)


def _short(stream: str, shown: Layout) -> str:
    """The stream's name without what all names begin with."""
    chunks = [name.split("/") for name in shown.streams]
    common = 0
    while all(len(c) > common + 2 and c[common] == chunks[0][common] for c in chunks):
        common += 1
    return "/".join(stream.split("/")[common:])
