"""What holds for every message type: validity of examples, immutability, digest, documentation."""

from __future__ import annotations

import inspect
import operator
import re

import numpy as np
import pytest
from example_messages import example
from messages_page import families

import dataflow.messages
from dataflow.messages import Message, MessageError
from dataflow.messages.base import ArrayField, ScalarField
from dataflow.recording.streams.codecs import codec_for

TYPES = [cls for classes in families().values() for cls in classes]
EXAMPLES = [(cls, seed) for cls in TYPES for seed in range(8)]
"""Of every type the full, the empty and the bare example, and five that mix."""
INSTEAD_OF_NONE = {"bool": False, "int": 0, "float": 0.0, "str": "", "strs": ()}


def test_message_types_are_complete() -> None:
    wanted = """
        Image Image16 CompressedImage CompressedVideo DepthImage CompressedDepth RelativeDepth CameraInfo
        PointCloud Imu MagneticField LaserScan RadarScan RangeReading NavSatFix Point Pose Transforms Odometry Twist
        WheelTicks JointState Detections2D Keypoints2D Boxes3D
        SegmentationMap Tracks FeatureVector SceneGraph Activity Diagnostics LandmarkSightings Path OccupancyGrid Rooms
        Mesh Planes Clusters Classification ParticleSet Number Measurement Text Switch Alarm"""
    assert {cls.SCHEMA for cls in TYPES} == set(wanted.split())
    assert {cls.SCHEMA for cls in TYPES} <= set(dataflow.messages.__all__)


def test_an_example_is_valid_frozen_and_the_same_for_its_seed() -> None:
    for cls, seed in EXAMPLES:
        message = example(cls, seed)
        assert type(message) is cls
        assert message.digest() == example(cls, seed).digest()
        assert len({example(cls, seed + k).digest() for k in range(4)}) > 1
        for data in message.arrays():
            assert data is None or not data.flags.writeable
        with pytest.raises(AttributeError, match="immutable"):
            message.stamp = 0


def test_a_message_survives_being_taken_apart() -> None:
    for cls, seed in EXAMPLES:
        message = example(cls, seed)
        assert cls.from_parts(message.stamp, message.header(), message.arrays()).digest() == message.digest()
        assert cls(**dict(message.items())) == message
        assert message.replace() == message


def test_every_field_counts_in_the_digest() -> None:
    for cls, seed in EXAMPLES:
        message = example(cls, seed)
        before = message.digest()
        kinds = {spec.name: spec.kind for spec in cls.SCALARS}
        for name, value in message.items():
            twin = object.__new__(cls)  # around validation, which refuses some of the changes
            twin.__dict__.update(message.__dict__)
            twin.__dict__[name] = INSTEAD_OF_NONE[kinds[name]] if value is None and name in kinds else _other(value)
            assert twin.compute_digest() != before, name


def _other(value: object) -> object:
    """A value that differs from the given one as little as its kind allows."""
    match value:
        case None:
            return np.zeros(0, np.uint8)
        case bool():
            return not value
        case int():
            return value + 1
        case float():
            bits = np.array(value).view(np.uint64) ^ np.uint64(1)
            return float(bits.view(np.float64))
        case str():
            return value + " "
        case tuple():
            return (*value, "")
        case np.ndarray() if value.size:
            changed = value.copy()
            changed.reshape(-1).view(np.uint8)[-1] ^= 1
            return changed
        case np.ndarray():
            return np.zeros((1, *value.shape[1:]), value.dtype)
    raise AssertionError(f"no other value known for {value!r}")


def test_a_missing_or_unknown_field_is_named() -> None:
    for cls in TYPES:
        values = dict(example(cls, 0).items())
        with pytest.raises(MessageError, match=rf"{cls.SCHEMA} has no field 'nonsense'; its fields: stamp, "):
            cls(**values, nonsense=1)
        anchored = [f.name for f in cls.SCALARS if f.anchored]
        required = [f.name for f in cls.FIELDS if f.required and f.name not in anchored]
        assert required, "a message without a required field says nothing"
        for name in required:
            with pytest.raises(MessageError, match=rf"{cls.SCHEMA}\.{name} is required"):
                cls(**{k: v for k, v in values.items() if k != name})
        for name in ("stamp", *anchored):
            incomplete = cls(**{k: v for k, v in values.items() if k != name})
            assert re.search(rf"\b{name}=", repr(incomplete)) is None
            uses = (operator.attrgetter(name), Message.digest, codec_for(cls).encode, cls.compiled().content)
            for use in uses[: 3 if name == "stamp" else 4]:  # the content is without the stamp
                with pytest.raises(MessageError, match=rf"{cls.SCHEMA} has no {name}: .* give {name}="):
                    use(incomplete)


def test_an_array_of_the_wrong_rank_is_named() -> None:
    for cls in TYPES:
        values = dict(example(cls, 0).items())
        for field in cls.ARRAYS:
            wrong = np.zeros((1, 1, 1, 1, 1), field.dtypes[0])
            with pytest.raises(MessageError, match=rf"{cls.SCHEMA}\.{field.name} must have shape \("):
                cls(**(values | {field.name: wrong}))


def test_optional_fields_may_be_left_out() -> None:
    for cls in TYPES:
        bare = {k: v for k, v in example(cls, 2).items() if v is not None}
        message = cls(**bare)
        assert all(v is None for k, v in message.items() if k not in bare)


def test_every_class_field_and_helper_is_documented() -> None:
    for cls in TYPES:
        assert cls.__doc__
        assert cls.__doc__ != Message.__doc__
        for name, member in vars(cls).items():
            if not name.startswith("_") and name != "validate":
                function = member.__func__ if isinstance(member, classmethod) else member
                assert inspect.getdoc(function), name
        for field in cls.FIELDS:
            assert len(field.doc) > 3, field.name


DIMENSIONLESS = re.compile(
    r"quaternion|\[0, 1\]|unit (surface )?normal|sensor's own scale|rotation|coefficients|embedding|weight"
)


def test_every_measured_quantity_has_a_unit() -> None:
    for cls in TYPES:
        for field in cls.FIELDS:
            if isinstance(field, ArrayField) and field.dtypes[0].kind == "f":
                assert field.unit or DIMENSIONLESS.search(field.doc), field.name
            if isinstance(field, ScalarField) and field.kind == "float":
                assert re.search(r"metres|radians|degrees|`unit`", field.doc), field.name


def test_frames_are_named_where_they_apply() -> None:
    for cls in TYPES:
        names = [f.name for f in cls.FIELDS]
        values = {"Number", "Text", "Switch", "Alarm"}
        without = {"WheelTicks", "JointState", "Activity", "Diagnostics", "Transforms", *values}
        assert ("frame" in names) == (cls.SCHEMA not in without)


def test_annotations_agree_with_the_declaration() -> None:
    for cls in TYPES:
        annotations = inspect.get_annotations(cls)
        for field in cls.FIELDS:
            text = annotations[field.name]
            assert ("None" in text) == field.optional, field.name
            if isinstance(field, ArrayField):
                wanted = " | ".join(f"{'U' if d.kind == 'u' else d.kind.upper()}{8 * d.itemsize}" for d in field.dtypes)
                assert text.removesuffix(" | None") == wanted, field.name
            else:
                wanted = {"strs": "tuple[str, ...]"}.get(field.kind, field.kind)
                assert text.removesuffix(" | None") == wanted, field.name


def test_examples_include_edge_cases_for_codecs() -> None:
    messages = [example(cls, seed) for cls in TYPES for seed in range(8)]
    floats = [a for m in messages for a in m.arrays() if a is not None and a.dtype.kind == "f"]
    for width, unsigned in ((4, np.uint32), (8, np.uint64)):
        values = np.concatenate([a.reshape(-1) for a in floats if a.itemsize == width])
        nans = values[np.isnan(values)].view(unsigned)
        assert len(np.unique(nans)) > 1, "NaN with and without a payload"
        assert (values.view(unsigned) == unsigned(1) << unsigned(8 * width - 1)).any(), "-0.0"
        assert np.isinf(values).any()
    texts = [
        w for m in messages for v in m.header() for w in (v if isinstance(v, tuple) else (v,)) if isinstance(w, str)
    ]
    assert any(not t.isascii() for t in texts)
    assert "" in texts
    assert any(m.stamp == 0 for m in messages)
    whole = [a for m in messages for a in m.arrays() if a is not None and a.dtype == np.int64 and a.size]
    assert max(a.max() for a in whole) > 2**53


def test_the_first_seeds_are_full_empty_and_bare() -> None:
    for cls in TYPES:
        full, empty, bare = (example(cls, seed) for seed in range(3))
        for field in cls.FIELDS:
            value = dict(bare.items())[field.name]
            assert (value is None) == field.optional or cls.SCHEMA in ("Tracks", "LandmarkSightings"), field.name
        counts = [
            a.shape[0] for f, a in zip(cls.ARRAYS, empty.arrays(), strict=True) if a is not None and "N" in f.shapes[0]
        ]
        assert not any(counts) or cls.SCHEMA.startswith(("Compressed", "CameraInfo"))
        exclusive = {"LandmarkSightings"}  # polar or Cartesian, never both
        assert all(v is not None for _, v in full.items()) or cls.SCHEMA in exclusive
