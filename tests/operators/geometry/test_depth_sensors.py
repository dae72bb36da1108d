"""Noise of depth cameras by name: the data, and what the operators take from it."""

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from operators.geometry.depth_sensors import FILE, DepthSensor, read_depth_sensor
from operators.odometry import VisualOdometry
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import DepthNoise
from operators.scene import SemanticMap
from operators.scene.map.matching import MapSettings
from operators.slam import VisualSlam

NAMES = list(YAML(typ="safe").load(FILE.read_text(encoding="utf-8")))
CAMERAS = (VisualOdometry, VisualSlam)


def sigma(sensor: DepthSensor | None, z: float) -> float:
    return sensor.floor + sensor.quadratic * z * z


@pytest.mark.parametrize(
    ("name", "z", "published"),
    [("kinect_v1", 5.0, 0.036), ("realsense_l515", 1.0, 0.0025), ("realsense_l515", 9.0, 0.0155)],
)
def test_sensors_have_the_noise_that_was_published(name: str, z: float, published: float) -> None:
    assert sigma(read_depth_sensor(name), z) == pytest.approx(published, rel=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_every_sensor_has_a_source_and_a_range(name: str) -> None:
    sensor = read_depth_sensor(name)
    assert len(sensor.source) > 20
    assert sensor.range[0] < sensor.range[1]


def test_a_stereo_camera_follows_from_its_geometry(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("{floor: 0.001, baseline: 0.12, focal: 700, subpixel: 0.2}", encoding="utf-8")
    assert sigma(read_depth_sensor(str(tmp_path / "mine.yaml")), 2.0) == pytest.approx(0.001 + 4 * 0.2 / (700 * 0.12))


@pytest.mark.parametrize("text", ["[1]", "{floor: 0.001, focal: 700}", "{floor: 0.001, quadratic: -1}", "{a: b: c}"])
def test_a_file_that_describes_no_sensor_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"mine\.yaml describes no depth sensor"):
        read_depth_sensor(str(tmp_path / "mine.yaml"))


@pytest.mark.parametrize("kind", [*CAMERAS, SemanticMap])
def test_an_unknown_sensor_is_an_error_that_lists_the_known(kind: type) -> None:
    with pytest.raises(ValueError, match=r"no depth sensor 'kinect'.*kinect_v1.*realsense_d435"):
        kind(depth_sensor="kinect").setup()


@pytest.mark.parametrize("kind", CAMERAS)
def test_depth_noise_follows_the_sensor_unless_given(kind: type) -> None:
    def noise(**params: object) -> DepthNoise:
        operator = kind(**params)
        operator.setup()
        config: RgbdOdometryConfig = operator._config()
        return config.depth_noise

    assert noise() == DepthNoise(0.002, 0.002)
    assert noise(depth_sensor="kinect_v1") == DepthNoise(0.0003, 0.001425)
    assert noise(depth_sensor="kinect_v1", depth_noise_floor=0.002) == DepthNoise(0.002, 0.001425)
    assert noise(depth_noise_quadratic=0.0) == DepthNoise(0.002, 0.0)


@pytest.mark.parametrize(("name", "range_noise"), [("", MapSettings().range_noise), ("kinect_v1", 0.001425)])
def test_map_takes_the_range_noise_of_the_sensor(name: str, range_noise: float) -> None:
    operator = SemanticMap(depth_sensor=name)
    operator.setup()
    operator.state = operator.initial_state()
    assert operator._made()._settings.range_noise == range_noise
