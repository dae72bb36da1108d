"""Fields of many messages as numpy arrays and pandas tables."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from analysed import MS, START

import dataflow
from dataflow.api.columns import column, expanded
from dataflow.messages import Odometry, WheelTicks

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    import pandas as pd


def test_vectors_scalars_and_timestamps_are_arrays(recording: dataflow.RecordedStreams) -> None:
    imu = recording["imu"]

    rates = imu["angular_velocity"]
    assert rates.shape == (11, 3)
    assert rates.dtype == np.float64
    np.testing.assert_array_equal(rates[:, 0], np.arange(11.0))
    assert imu["stamp"].tolist() == [START + 10 * MS * i for i in range(11)]
    np.testing.assert_array_equal(imu["temperature"], [np.nan if i % 2 == 0 else 20.0 + i for i in range(11)])
    assert imu["frame"].tolist() == ["imu"] * 11


def test_columns_equal_the_message_fields(recording: dataflow.RecordedStreams) -> None:
    for stream in recording.select("imu", "image", "objects", "info").values():
        for name in stream.fields:
            values = [getattr(message, name) for message in stream]
            for found, value in zip(stream.column(name), values, strict=True):
                if value is None:
                    assert found is None or np.all(np.isnan(found))
                else:
                    np.testing.assert_array_equal(found, value)


def test_images_of_one_size_are_stacked_and_lists_of_any_length_stay_apart(recording: dataflow.RecordedStreams) -> None:
    assert recording["image"]["data"].shape == (3, 3, 4, 3)
    boxes = recording["objects"]["boxes"]
    assert boxes.dtype == object
    assert [one.shape for one in boxes] == [(0, 4), (1, 4), (2, 4)]


def test_a_part_has_the_columns_of_its_messages(recording: dataflow.RecordedStreams) -> None:
    assert recording["imu"][2:4]["angular_velocity"][:, 0].tolist() == [2.0, 3.0]
    assert recording["imu"].between(5)["angular_velocity"].shape == (0, 3)


def test_an_unknown_field_is_an_error_with_the_nearest_one(recording: dataflow.RecordedStreams) -> None:
    with pytest.raises(KeyError, match="Imu has no field 'angular_speed': did you mean 'angular_velocity'"):
        recording["imu"].column("angular_speed")


def test_a_table_has_a_row_for_each_message_and_a_column_for_each_component(
    recording: dataflow.RecordedStreams,
) -> None:
    frame = recording["imu"].frame()

    assert list(frame.columns) == [
        "stamp", "seconds", "frame", "temperature",
        "angular_velocity.x", "angular_velocity.y", "angular_velocity.z",
        "linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z",
    ]  # fmt: skip
    assert frame["angular_velocity.z"].tolist() == [-float(i) for i in range(11)]
    assert frame.index[1] == pd.Timestamp(START + 10 * MS, tz="UTC")
    assert frame["seconds"].iloc[-1] == pytest.approx(0.1)


def test_fields_that_are_asked_for_are_there_whatever_they_hold(recording: dataflow.RecordedStreams) -> None:
    frame = recording["imu"].frame("orientation", "orientation_covariance")

    assert list(frame.columns)[2:6] == [f"orientation.{axis}" for axis in "xyzw"]
    assert "orientation_covariance.2.1" in frame
    assert frame["orientation.w"].isna().all()


def test_a_table_of_elements_has_a_row_for_each_detection(recording: dataflow.RecordedStreams) -> None:
    frame = recording["objects"].elements()

    assert frame["message"].tolist() == [1, 2, 2]
    assert frame["element"].tolist() == [0, 0, 1]
    assert frame["class_name"].tolist() == ["cat", "cat", "dog"]
    assert frame["boxes.x"].tolist() == [0.0, 0.0, 4.0]
    assert frame["stamp"].tolist() == [START + 40 * MS, START + 80 * MS, START + 80 * MS]
    assert "class_names" not in frame
    assert recording["objects"].elements("scores")["scores"].tolist() == [0.5] * 3


def test_elements_of_messages_without_parallel_arrays_are_refused(recording: dataflow.RecordedStreams) -> None:
    with pytest.raises(TypeError, match=r"Imu, which has no parallel arrays; use frame\(\)"):
        recording["imu"].elements()


def test_frame_without_pandas_names_the_extra_and_columns_still_work(
    recording: dataflow.RecordedStreams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'robot-dataflow\[notebook\]'; columns\(\)"):
        recording["imu"].frame()

    assert recording["imu"].columns()["temperature"].shape == (11,)


def test_a_field_that_is_none_in_all_messages() -> None:
    (covariance,) = (f for f in Odometry.FIELDS if f.name == "pose_covariance")
    found = column(covariance, [None, None])
    assert found.shape == (2, 6, 6)
    assert np.isnan(found).all()
    (radii,) = (f for f in WheelTicks.FIELDS if f.name == "radii")
    assert column(radii, [None]).tolist() == [None]


def test_components_are_named_by_axis_or_number() -> None:
    assert [name for name, _ in expanded("v", np.zeros((2, 3)))] == ["v.x", "v.y", "v.z"]
    assert [name for name, _ in expanded("k", np.zeros((2, 2, 2)))] == ["k.0.0", "k.0.1", "k.1.0", "k.1.1"]
    assert [name for name, _ in expanded("p", np.zeros((2, 5)))] == [f"p.{i}" for i in range(5)]
