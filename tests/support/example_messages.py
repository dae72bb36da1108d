"""Valid, random, awkward messages of any declared type, for round-trip tests of codecs, recordings and viewers."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from dataflow.messages import pack_masks
from dataflow.messages.base import ArrayField, Message, ScalarField

M = TypeVar("M", bound=Message)
Values = dict[str, Any]
Rng = np.random.Generator

WORDS = (
    *("lidar", "base_link", "Küche", "cuisine d'été", "機械", "🤖", 'a "quoted" \\ word', "two\nlines"),
    *("e\u0301", "a/b", ""),
)
AWKWARD = (0x7FC00000, 0xFFC00123, 0x80000000, 0x00000001, 0x7F800000, 0xFF800000)
"""float32 bits: NaN, a negative NaN with a payload, -0.0, the smallest denormal, +inf, -inf."""

SHARES = {"scores", "visible", "relation_scores", "probabilities"}
NONNEGATIVE = {"sizes", "ages", "unseen", "extents", "weights", "areas", "door_widths"}
QUATERNIONS = {"orientation", "orientations", "rotations"}
ALWAYS_SOME = {"H", "W", "D", "C"}
"""Extents that are never 0."""


def example(cls: type[M], seed: int = 0) -> M:
    """A valid message of the type, the same one for the same seed.

    Seed 0 has every optional field and no empty set; seed 1 has no element in any set (N = 0); seed 2 has no optional
    field; others mix. Float arrays hold NaN (with a payload), -0.0, infinities and a denormal wherever the type allows
    them; strings are not only ASCII. A type declared elsewhere is drawn from its declaration alone, so this raises
    `MessageError` where its own `validate()` asks for more.
    """
    rng = np.random.default_rng([seed, zlib.crc32(cls.SCHEMA.encode())])
    extents: dict[str, int] = {}
    values: Values = {"stamp": (0, int(rng.integers(2**62)), 1_700_000_000_123_456_789)[rng.integers(3)]}
    for field in cls.FIELDS:
        if field.optional and (seed == 2 or (seed > 2 and rng.random() < 0.5)):
            values[field.name] = None
        elif isinstance(field, ScalarField):
            values[field.name] = _scalar(field, rng)
        else:
            values[field.name] = _array(field, rng, extents, seed)
    repair = _REPAIRS.get(cls.SCHEMA)
    if repair is not None:
        repair(values, rng)
    return cls(**values)


def _scalar(field: ScalarField, rng: Rng) -> Any:
    if field.choices:
        return str(rng.choice(field.choices))
    match field.kind:
        case "bool":
            return bool(rng.integers(2))
        case "int":
            return int(rng.integers(1, 2**40))
        case "float":
            return float(rng.choice([rng.uniform(1e-6, 1e3), 0.1, 1e-300, 1e15]))
        case "str":
            return str(rng.choice(WORDS))
        case "strs":
            return _words(int(rng.integers(1, 5)), rng)


def _array(field: ArrayField, rng: Rng, extents: dict[str, int], seed: int) -> npt.NDArray[Any]:
    shape_of = field.shapes[int(rng.integers(len(field.shapes)))]
    shape = []
    for extent in shape_of:
        if isinstance(extent, str):
            lowest = 1 if seed == 0 or extent in ALWAYS_SOME else 0
            drawn = int(rng.integers(lowest, 7))
            extent = extents.setdefault(extent, 0 if seed == 1 and extent not in ALWAYS_SOME else drawn)
        shape.append(extent)
    dtype = field.dtypes[int(rng.integers(len(field.dtypes)))]
    if dtype.kind == "f":
        if field.name in QUATERNIONS:
            return _quaternions(tuple(shape), rng)
        if field.name in SHARES:
            return _sprinkled(rng.random(shape).astype(dtype), [-0.0, 0.0, 1.0], rng)
        if field.name in NONNEGATIVE:
            return _sprinkled(rng.uniform(0, 10, shape).astype(dtype), [-0.0, 0.0], rng)
        return _awkward(shape, dtype, rng)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    info = np.iinfo(dtype)
    data = rng.integers(info.min, info.max, shape, dtype=dtype, endpoint=True)
    return _sprinkled(data, [info.min, info.max], rng)


def _awkward(shape: list[int], dtype: np.dtype[Any], rng: Rng) -> npt.NDArray[Any]:
    data = rng.normal(0, 10, shape).astype(dtype)
    odd = np.array(AWKWARD, np.uint32).view(np.float32)
    if dtype.itemsize == 8:  # payloads of float64 survive in 64 bits only
        odd = np.array([0x7FF8000000000000, 0xFFF8000000000123, 1 << 63, 1, 0x7FF << 52, 0xFFF << 52], np.uint64).view(
            "f8"
        )
    flat = data.reshape(-1)
    where = rng.permutation(flat.size)[: max(flat.size // 3, 1)]
    flat[where] = odd[rng.integers(len(odd), size=len(where))]
    return data


def _sprinkled(data: npt.NDArray[Any], special: list[Any], rng: Rng) -> npt.NDArray[Any]:
    flat = data.reshape(-1)
    for value in special[: flat.size]:
        flat[rng.integers(flat.size)] = value
    return data


def _quaternions(shape: tuple[int, ...], rng: Rng) -> npt.NDArray[np.float64]:
    q = rng.normal(size=shape)
    q /= np.sqrt((q * q).sum(axis=-1, keepdims=True))
    if q.ndim == 1 or len(q) > 1:
        q.reshape(-1, 4)[0] = rng.choice([q.reshape(-1, 4)[0], np.array([-0.0, 0.0, -0.0, 1.0])])
    return q * (1 + 5e-4 * rng.random())  # off unit length within the tolerance: nobody may renormalise


def _words(count: int, rng: Rng) -> tuple[str, ...]:
    return tuple(str(w) for w in rng.choice(WORDS, size=count))


def _distinct(count: int, rng: Rng) -> tuple[str, ...]:
    return tuple(f"{word}{i}" for i, word in enumerate(_words(count, rng)))


def _finite(data: npt.NDArray[Any], rng: Rng) -> npt.NDArray[Any]:
    return _sprinkled(rng.normal(0, 10, data.shape).astype(data.dtype), [-0.0], rng)


def _boxes(values: Values, rng: Rng) -> None:
    if values["boxes"] is not None:
        count = len(values["boxes"])
        corners = rng.uniform(-20, 640, (count, 2, 2)).astype(np.float32)
        values["boxes"] = np.sort(corners, axis=1).reshape(count, 4)


def _classes(values: Values, rng: Rng) -> None:
    top = len(values["class_names"]) or 1000
    values["class_ids"] = rng.integers(0, top, values["class_ids"].shape, dtype=np.int32)


def _unique_ids(values: Values, rng: Rng) -> None:
    count = len(values["ids"])
    values["ids"] = np.array([2**62, -(2**63), 7, 2**53 + 1, -1, 0, 3][:count], np.int64)[rng.permutation(count)]


def _encoded(extension: str, pixels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    import cv2

    done, data = cv2.imencode(extension, pixels)
    if not done:
        raise RuntimeError(f"OpenCV cannot encode a {pixels.dtype} image as {extension}")
    return np.asarray(data, np.uint8).reshape(-1)


def _compressed_image(values: Values, rng: Rng) -> None:
    extension = {"jpeg": ".jpg", "png": ".png", "webp": ".webp"}[values["format"]]
    values["data"] = _encoded(extension, rng.integers(0, 256, (6, 9, 3), dtype=np.uint8))


def _compressed_video(values: Values, rng: Rng) -> None:
    delimiter = {"h264": b"\0\0\0\1\x09", "h265": b"\0\0\0\1\x46\1"}[values["format"]]
    values["data"] = np.frombuffer(delimiter + rng.bytes(int(rng.integers(1, 40))), np.uint8)


def _compressed_depth(values: Values, rng: Rng) -> None:
    values["data"] = _encoded(".png", rng.integers(0, 2**16, (6, 9), dtype=np.uint16))


def _camera_info(values: Values, rng: Rng) -> None:
    fx, fy, cx, cy = rng.uniform(100, 900, 4)
    values["K"] = np.array([[fx, -0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if values["distortion"] is None:
        values["distortion_model"] = "none"
    else:
        model = rng.choice(["plumb_bob", "rational_polynomial", "equidistant", "作り付け"])
        values["distortion_model"] = str(model)
        values["distortion"] = rng.normal(size={"plumb_bob": 5, "rational_polynomial": 8}.get(model, 4))
    for name in ("R", "P"):
        if values[name] is not None:
            values[name] = _finite(values[name], rng)


def _clusters(values: Values, rng: Rng) -> None:
    values["labels"] = rng.integers(-1, len(values["centroids"]), values["labels"].shape, dtype=np.int32)


def _laser_scan(values: Values, rng: Rng) -> None:
    values["range_max"] = float(rng.choice([np.inf, values["range_min"] + 30.0]))


def _transforms(values: Values, rng: Rng) -> None:
    count = len(values["translations"])
    values["frames"] = _words(count, rng)
    values["child_frames"] = _distinct(count, rng)


def _path(values: Values, rng: Rng) -> None:
    if values["stamps"] is not None:
        values["stamps"] = np.cumsum(rng.integers(1, 2**56, values["stamps"].shape, dtype=np.int64)) - 2**55


def _nav_sat_fix(values: Values, rng: Rng) -> None:
    if values["status"] == "no_fix":
        values.update(latitude=float("nan"), longitude=float("nan"), altitude=float("nan"))
    else:
        values.update(latitude=float(rng.uniform(-90, 90)), longitude=float(rng.choice([-180.0, -0.0, 7.4])))


def _particle_set(values: Values, rng: Rng) -> None:
    if values["poses"].shape[1] == 7:
        values["poses"][:, 3:] = _quaternions((len(values["poses"]), 4), rng)


def _named(*parallel_to: str) -> Callable[[Values, Rng], None]:
    def repair(values: Values, rng: Rng) -> None:
        lengths = [len(values[name]) for name in parallel_to if values[name] is not None]
        values["names"] = _distinct(lengths[0] if lengths else 3, rng)

    return repair


def _detections(values: Values, rng: Rng) -> None:
    _boxes(values, rng)
    _classes(values, rng)
    if values["masks"] is not None:
        width, height = (int(extent) for extent in rng.integers(1, 20, 2))
        pixels = rng.integers(0, 2, (len(values["boxes"]), height, width)).astype(bool)
        values.update(width=width, height=height, masks=pack_masks(pixels))


def _keypoints(values: Values, rng: Rng) -> None:
    count = values["points"].shape[1]
    values["names"] = _distinct(count, rng) if values["names"] else ()
    values["links"] = rng.integers(0, max(count, 1), values["links"].shape).astype(np.int32)[: count * 9]
    values["scores"] = rng.random(values["points"].shape[:2]).astype(np.float32)


def _segmentation_map(values: Values, rng: Rng) -> None:
    classes = values["classes"]
    values["classes"] = rng.integers(0, len(values["class_names"]), classes.shape, dtype=classes.dtype)
    if values["void"] is not None:
        values["void"] = 255
        values["classes"][0, 0] = 255
    if values["confidence"] is not None:
        values["confidence"] = _sprinkled(rng.random(classes.shape).astype(np.float32), [np.nan, -0.0, 1.0], rng)


def _tracks(values: Values, rng: Rng) -> None:
    _boxes(values, rng)
    _classes(values, rng)
    _unique_ids(values, rng)
    values["states"] = rng.integers(0, 4, values["states"].shape, dtype=np.uint8)
    if values["width"] is None or values["height"] is None:
        values["width"] = values["height"] = None
    if values["boxes"] is None and values["positions"] is None:
        values["positions"] = rng.normal(size=(len(values["ids"]), 3))


def _landmark_sightings(values: Values, rng: Rng) -> None:
    count = len(values["ids"])
    values["ids"] = rng.integers(-1, 500, count)
    polar = ("ranges", "bearings", "elevations")
    if values["positions"] is not None and rng.random() < 0.5:
        values.update(dict.fromkeys(polar))
        dimension = values["positions"].shape[1]
    else:
        values["positions"] = None
        if values["bearings"] is None:
            values["bearings"] = rng.uniform(-np.pi, np.pi, count)
        dimension = sum(values[name] is not None for name in polar)
    if values["covariances"] is not None:
        values["covariances"] = rng.normal(size=(count, dimension, dimension))


def _scene_graph(values: Values, rng: Rng) -> None:
    _classes(values, rng)
    _unique_ids(values, rng)
    nodes = len(values["ids"])
    values["labels"] = _words(nodes, rng) if rng.random() < 0.7 else ()
    relations = len(values["subjects"]) if nodes else 0
    values["predicates"] = _words(relations, rng)
    for name in ("subjects", "objects"):
        values[name] = rng.integers(0, max(nodes, 1), relations, dtype=np.int32)
    if values["relation_scores"] is not None:
        values["relation_scores"] = rng.random(relations).astype(np.float32)
    if values["moving"] is not None:
        values["moving"] = rng.random(nodes).astype(np.float32)
    if values["tracks"] is not None:
        count = len(values["tracks"]) if nodes else 0
        values["tracks"] = values["tracks"][:count]
        values["track_nodes"] = rng.integers(0, max(nodes, 1), count, dtype=np.int32)
    else:
        values["track_nodes"] = None


def _activity(values: Values, rng: Rng) -> None:
    _classes(values, rng)
    values["goals"] = _words(len(values["subjects"]), rng)
    _probabilities(values, rng, "subjects")


def _classification(values: Values, rng: Rng) -> None:
    _classes(values, rng)
    _probabilities(values, rng, "class_ids")


def _probabilities(values: Values, rng: Rng, of: str) -> None:
    if values["probabilities"] is not None:
        shape = (len(values[of]), len(values["class_names"]))
        values["probabilities"] = rng.random(shape).astype(np.float32)


def _feature_vector(values: Values, rng: Rng) -> None:
    values["labels"] = _words(len(values["vectors"]), rng)


def _occupancy_grid(values: Values, rng: Rng) -> None:
    values["cells"] = rng.integers(-1, 101, values["cells"].shape, dtype=np.int8)
    values["position"] = _finite(values["position"], rng)


def _mesh(values: Values, rng: Rng) -> None:
    corners = len(values["vertices"])
    shape = (len(values["triangles"]) if corners else 0, 3)
    values["triangles"] = rng.integers(0, max(corners, 1), shape, dtype=np.uint32)


def _planes(values: Values, rng: Rng) -> None:
    count = len(values["coefficients"])
    normals = rng.normal(size=(count, 3))
    values["coefficients"][:, :3] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    rectangle = ("centers", "orientations", "extents")
    if any(values[name] is None for name in rectangle):
        values.update(dict.fromkeys(rectangle))
    if count and values["hulls"] is not None and values["hull_counts"] is not None:
        values["hull_counts"] = np.bincount(rng.integers(0, count, len(values["hulls"])), minlength=count)
    else:
        values.update(hulls=None, hull_counts=None)
    if values["labels"] is not None:
        values["labels"] = rng.integers(-1, count, values["labels"].shape, dtype=np.int32)


def _rooms(values: Values, rng: Rng) -> None:
    _unique_ids(values, rng)
    count = len(values["ids"])
    values["cells"] = rng.integers(-1, count, values["cells"].shape, dtype=np.int32)
    values["doors"] = rng.integers(0, max(count, 1), values["doors"].shape, dtype=np.int32)
    if not count:
        values.update(doors=values["doors"][:0], door_positions=values["door_positions"][:0])
        values.update(door_widths=values["door_widths"][:0])


def _diagnostics(values: Values, rng: Rng) -> None:
    count = len(values["levels"])
    values["levels"] = rng.integers(0, 4, count, dtype=np.uint8)
    for name in ("names", "messages", "hardware_ids"):
        values[name] = _words(count, rng)
    pairs = 0 if values["owners"] is None or not count else len(values["owners"])
    if values["owners"] is not None:
        values["owners"] = rng.integers(0, max(count, 1), pairs, dtype=np.int32)
    values["keys"], values["values"] = _words(pairs, rng), _words(pairs, rng)


def _organised(values: Values, rng: Rng) -> None:
    if values["columns"] is not None:
        values["columns"] = max(1, len(values["points"]))


_REPAIRS: dict[str, Callable[[Values, Rng], None]] = {
    "Activity": _activity,
    "Boxes3D": _classes,
    "Classification": _classification,
    "CameraInfo": _camera_info,
    "Clusters": _clusters,
    "CompressedDepth": _compressed_depth,
    "CompressedImage": _compressed_image,
    "CompressedVideo": _compressed_video,
    "Detections2D": _detections,
    "Diagnostics": _diagnostics,
    "FeatureVector": _feature_vector,
    "JointState": _named("positions", "velocities", "efforts"),
    "Keypoints2D": _keypoints,
    "LandmarkSightings": _landmark_sightings,
    "LaserScan": _laser_scan,
    "Mesh": _mesh,
    "NavSatFix": _nav_sat_fix,
    "OccupancyGrid": _occupancy_grid,
    "ParticleSet": _particle_set,
    "PointCloud": _organised,
    "Path": _path,
    "Planes": _planes,
    "Rooms": _rooms,
    "SceneGraph": _scene_graph,
    "SegmentationMap": _segmentation_map,
    "Tracks": _tracks,
    "Transforms": _transforms,
    "WheelTicks": _named("ticks"),
}
"""Brings drawn values into line with what a type's `validate()` asks of them."""
