"""The sensors' parameters: rate, place on the robot, noise and faults of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from dataflow.operator import Duration

Mount = tuple[float, float, float, float, float, float]
"""x, y, z (m), roll, pitch, yaw (rad) on the robot: of a camera's housing with x forward, y left, z up."""


class Sensor(BaseModel):
    """Settings that all sensors have. A sensor with rate 0 is off and costs nothing."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate: float = Field(0.0, ge=0, le=1000, description="measurements a second; 0 switches the sensor off")
    phase: Duration = Field(0, description="time of the first measurement after the start")
    delay: Duration = Field(0, description="how much older than its stamp a measurement is: a wrong clock")
    clock_drift: float = Field(
        0.0, ge=0, lt=0.1, description="how much older it gets every second, seconds: a clock that goes wrong"
    )
    dropout: float = Field(0.0, ge=0, le=1, description="probability that a measurement is missing")
    outages: tuple[tuple[float, float], ...] = Field(
        (), description="spans (from, to) in seconds since the start without any measurement"
    )
    frozen: float = Field(0.0, ge=0, le=1, description="probability that a measurement repeats the last one")


class Placed(Sensor):
    """A sensor with a place on the robot."""

    mount_error: Mount = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        description="where it really is, seen from where its calibration puts it: a wrong calibration",
    )


class Camera(Placed):
    """A sensor with a separate calibration."""

    focal_error: float = Field(
        0.0, gt=-0.5, lt=1, description="the calibration's focal length is too long by this share"
    )


class ColorCamera(Camera):
    """A colour camera with square pixels and no distortion."""

    rate: float = Field(10.0, ge=0, le=200, description="images a second; 0 switches the camera off")
    width: int = Field(320, ge=16, le=4096, description="columns")
    height: int = Field(240, ge=16, le=4096, description="rows")
    focal: float = Field(0.85, gt=0.1, le=10, description="focal length as a share of the width")
    mount: Mount | None = Field(
        None, description="place on the robot; the world's own (it looks where it should) if none"
    )
    output: Literal["raw", "jpeg", "both"] = Field("raw", description="ports that it feeds: image, image_jpeg or both")
    jpeg_quality: int = Field(88, ge=1, le=100, description="of image_jpeg")
    exposure: float = Field(1.0, gt=0, description="brightness")
    exposure_change: float = Field(0.06, ge=0, lt=1, description="how far brightness swings about its mean, slowly")
    read_noise: float = Field(1.2, ge=0, description="standard deviation in the dark, of 255")
    shot_noise: float = Field(
        0.08, ge=0, description="standard deviation at brightness b is this times sqrt(b), of 255"
    )
    shutter: Duration = Field(
        0, description="how long the shutter is open: motion blur by the robot's turning; 0 for none"
    )
    black: float = Field(0.0, ge=0, le=1, description="probability of a black frame")


class DepthCamera(Camera):
    """A depth camera that measures inverse depth, as stereo and structured light do: errors grow with z²."""

    rate: float = Field(10.0, ge=0, le=200, description="images a second; 0 switches the camera off")
    width: int | None = Field(None, ge=16, le=4096, description="columns; the colour camera's if none")
    height: int | None = Field(None, ge=16, le=4096, description="rows; the colour camera's if none")
    focal: float | None = Field(None, gt=0.1, le=10, description="share of the width; the colour camera's if none")
    offset: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="of the depth camera in the colour camera's optical frame, metres; 0 is registered"
    )
    rotation: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="of the depth camera in that frame, radians about its fixed x, then y, then z axis"
    )
    output: Literal["raw", "png", "both"] = Field("raw", description="ports that it feeds: depth, depth_png or both")
    min_range: float = Field(0.25, gt=0, description="nearer things have no return, metres")
    max_range: float = Field(6.0, gt=0, description="farther things have no return, metres")
    noise: float = Field(0.0015, ge=0, description="standard deviation at 1 m, metres; at z it is this times z²")
    grain: int = Field(3, ge=1, le=16, description="noise is alike over so many pixels")
    quantum: float = Field(0.002, gt=1e-4, description="step of the depths at 1 m, metres; at z it is this times z²")
    bias: float = Field(0.0, gt=-0.5, lt=0.5, description="depths are too long by this share")
    grazing: float = Field(0.12, ge=0, lt=1, description="no return where the cosine of ray and normal is less")
    edge_holes: float = Field(0.5, ge=0, le=1, description="probability of no return on the brink of a depth step")
    specks: float = Field(0.002, ge=0, le=1, description="probability of no return anywhere")
    missing: float = Field(0.0, ge=0, le=1, description="share of the image without return, in patches")
    black: float = Field(0.0, ge=0, le=1, description="probability of a frame without any return")


class StereoRig(Camera):
    """Two parallel cameras."""

    width: int = Field(320, ge=16, le=4096, description="columns")
    height: int = Field(240, ge=16, le=4096, description="rows")
    focal: float = Field(0.85, gt=0.1, le=10, description="focal length as a share of the width")
    mount: Mount | None = Field(None, description="place of the left camera on the robot; the colour camera's if none")
    baseline: float = Field(0.12, gt=0, description="distance of the right camera from the left one, metres")
    color: bool = Field(False, description="RGB instead of grey")
    exposure: float = Field(1.0, gt=0, description="brightness")
    read_noise: float = Field(1.5, ge=0, description="standard deviation in the dark, of 255")
    shot_noise: float = Field(
        0.08, ge=0, description="standard deviation at brightness b is this times sqrt(b), of 255"
    )
    black: float = Field(0.0, ge=0, le=1, description="probability of black frames")


class Lidar(Placed):
    """A rotating laser scanner; its stamp is the end of the sweep."""

    rings: int = Field(16, ge=1, le=256, description="laser channels")
    columns: int = Field(360, ge=4, le=4096, description="directions around")
    lower: float = Field(-0.2618, gt=-1.57, lt=1.57, description="elevation of the lowest ring, radians")
    upper: float = Field(0.2618, gt=-1.57, lt=1.57, description="elevation of the highest ring, radians")
    mount: Mount = Field((-0.05, 0.0, 0.62, 0.0, 0.0, 0.0), description="place on the robot")
    min_range: float = Field(0.2, ge=0, description="nearer returns are lost, metres")
    max_range: float = Field(30.0, gt=0, description="farther returns are lost, metres")
    noise: float = Field(0.012, ge=0, description="standard deviation of a range, metres")
    bias: float = Field(0.0, description="ranges are too long by this, metres")
    resolution: float = Field(
        0.00390625, ge=0, description="coordinates are rounded to this, metres (1/256 packs well); 0 for not at all"
    )
    missing: float = Field(0.01, ge=0, le=1, description="probability that a beam has no return")
    motion: bool = Field(
        False, description="the robot moves on during the sweep; the points say when each was measured"
    )


class Inertial(Placed):
    """An inertial measurement unit."""

    mount: Mount = Field((0.0, 0.0, 0.3, 0.0, 0.0, 0.0), description="place on the robot")
    gyro_noise: float = Field(1.7e-4, ge=0, description="noise density, rad/s/√Hz")
    accel_noise: float = Field(2.0e-3, ge=0, description="noise density, m/s²/√Hz")
    gyro_walk: float = Field(2.0e-5, ge=0, description="random walk of the bias, rad/s²/√Hz")
    accel_walk: float = Field(3.0e-4, ge=0, description="random walk of the bias, m/s³/√Hz")
    gyro_bias: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="at the start, rad/s")
    accel_bias: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="at the start, m/s²")
    gravity: float = Field(9.80665, gt=0, description="m/s²")


class Magnetometer(Placed):
    """A magnetometer in the Earth's field, which iron in the building bends; the world's x axis points east."""

    mount: Mount = Field((0.0, 0.0, 0.9, 0.0, 0.0, 0.0), description="place on the robot")
    strength: float = Field(48e-6, gt=0, description="of the Earth's field, teslas")
    inclination: float = Field(
        1.12, ge=-1.58, le=1.58, description="how far the field points below the horizon, radians"
    )
    declination: float = Field(0.06, description="of magnetic from true north, eastwards, radians")
    noise: float = Field(0.2e-6, ge=0, description="standard deviation, teslas")
    hard_iron: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="field of the robot itself, teslas")
    soft_iron: float = Field(0.0, ge=0, lt=0.5, description="the robot's iron stretches its x axis by this share")
    disturbance: float = Field(
        0.0, ge=0, description="standard deviation of the building's field, which changes over metres, teslas"
    )


class Wheels(Sensor):
    """Encoders of the two driven wheels, and odometry made of them."""

    radius: float = Field(0.08, gt=0, description="of a wheel, metres")
    track: float = Field(0.4, gt=0, description="distance between the wheels, metres")
    ticks_per_turn: int = Field(2048, ge=1, description="encoder counts a turn of the wheel")
    scale_error: float = Field(
        0.01, ge=0, lt=0.5, description="standard deviation of each wheel's constant scale error"
    )
    bias: tuple[float, float] = Field(
        (0.0, 0.0), description="left and right: what is counted is too long by this share of the way"
    )
    slip: float = Field(
        0.006, ge=0, description="standard deviation of a wheel's error after 1 m; grows with √distance"
    )


class Radar(Placed):
    """A radar with a fan of cells: range, bearing and Doppler velocity of what reflects."""

    mount: Mount = Field((0.2, 0.0, 0.45, 0.0, 0.0, 0.0), description="place on the robot")
    field: float = Field(2.0, gt=0, le=6.28, description="width of the fan, radians")
    max_range: float = Field(20.0, gt=0, description="metres")
    range_noise: float = Field(0.05, ge=0, description="standard deviation, metres")
    azimuth_noise: float = Field(0.015, ge=0, description="standard deviation, radians")
    velocity_noise: float = Field(0.05, ge=0, description="standard deviation, m/s")
    bias: float = Field(0.0, description="ranges are too long by this, metres")
    detection: float = Field(0.85, ge=0, le=1, description="probability that a reflector is detected")
    clutter: float = Field(0.5, ge=0, description="mean number of false detections a scan")


class Landmarks(Placed):
    """Sightings of known landmarks by range and bearing, or by bearing alone as a camera has them."""

    frame: str = Field("landmark_sensor", min_length=1, description="name of the sensor's frame")
    ranges: bool = Field(True, description="ranges are measured beside bearings")
    mount: Mount = Field((0.0, 0.0, 0.62, 0.0, 0.0, 0.0), description="place on the robot")
    field: float = Field(6.2832, gt=0, le=6.2832, description="width of the field of view, radians")
    max_range: float = Field(8.0, gt=0, description="metres")
    range_noise: float = Field(0.03, ge=0, description="standard deviation at 1 m, metres; grows with the range")
    bearing_noise: float = Field(0.01, ge=0, description="standard deviation, radians")
    bias: float = Field(0.0, description="ranges are too long by this, metres")
    unknown: float = Field(0.0, ge=0, le=1, description="probability that the identity of a sighting is not known")
    missing: float = Field(0.05, ge=0, le=1, description="probability that a landmark in view is not seen")


class Gnss(Placed):
    """A satellite receiver; the world's origin has the given coordinates, its x axis points east."""

    mount: Mount = Field((0.0, 0.0, 1.2, 0.0, 0.0, 0.0), description="place of the antenna on the robot")
    latitude: float = Field(48.1374, gt=-89, lt=89, description="of the world's origin, degrees")
    longitude: float = Field(11.5755, ge=-180, le=180, description="of the world's origin, degrees")
    altitude: float = Field(520.0, description="of the world's origin above the ellipsoid, metres")
    noise: float = Field(0.4, ge=0, description="standard deviation, horizontal, metres; vertical is twice as much")
    drift: float = Field(0.3, ge=0, description="standard deviation of a slowly changing error, metres")
    drift_time: float = Field(30.0, gt=0, description="time in which that error changes, seconds")
    bias: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="east, north, up, metres")
    sky: bool = Field(
        False, description="satellites need a free line of sight: fewer give worse fixes, fewer than four none"
    )


Mounted = Lidar | Inertial | Magnetometer | Radar | Landmarks | Gnss
"""Sensors with a separate mount."""


@dataclass(frozen=True)
class Sensors:
    """All sensors of the robot."""

    color_camera: ColorCamera
    depth_camera: DepthCamera
    stereo: StereoRig
    lidar: Lidar
    inertial: Inertial
    magnetometer: Magnetometer
    wheels: Wheels
    radar: Radar
    landmarks: Landmarks
    gnss: Gnss

    def mounted(self) -> dict[str, Mounted]:
        """Those with a separate mount, by frame."""
        return {
            "lidar": self.lidar,
            "imu": self.inertial,
            "magnetometer": self.magnetometer,
            "radar": self.radar,
            self.landmarks.frame: self.landmarks,
            "gnss": self.gnss,
        }

    def cast_rays(self) -> bool:
        """Returns whether any that is on needs the renderer."""
        seeing = (self.color_camera, self.depth_camera, self.stereo, self.lidar, self.radar, self.landmarks)
        return any(sensor.rate for sensor in seeing) or bool(self.gnss.rate and self.gnss.sky)


class Motion(BaseModel):
    """Models how the robot's body is shaken on its way."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    bumps: float = Field(
        0.0, ge=0, le=0.02, description="deviation of the floor's height under the robot, metres; it tilts accordingly"
    )
    sway: float = Field(0.0, ge=0, le=0.1, description="deviation of a swing as of a rig carried by hand, metres")
    turn: float = Field(0.0, ge=0, le=0.3, description="the same in roll, pitch and yaw, radians")


class Truth(BaseModel):
    """Settings of the world itself. A rate of 0 switches a stream off."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    poses: float = Field(10.0, ge=0, le=1000, description="true poses of robot and camera, a second")
    boxes: bool = Field(True, description="Detections2D and Boxes3D with every colour image")
    masks: bool = Field(False, description="SegmentationMap with every colour image")
    relations: float = Field(2.0, ge=0, le=100, description="true scene graphs a second")
    activities: float = Field(5.0, ge=0, le=100, description="true activities a second")
    min_pixels: int = Field(12, ge=1, description="objects with fewer visible pixels have no box")
    visible_share: bool = Field(True, description="work out how much of each object is hidden; costs a few ms an image")
    spatial: bool = Field(
        True, description="add near, left_of and in_front_of to the relations of placement and contact"
    )
    occupancy: bool = Field(False, description="the true map: which cells of the floor plan are taken")
    resolution: float = Field(0.05, ge=0.01, le=1, description="side of a cell of it, metres")
    band: tuple[float, float] = Field(
        (0.05, 1.5), description="heights between which a thing takes the cells that it covers, metres"
    )
    surfaces: bool = Field(False, description="the true planes: floor, walls, table tops, boards")
    mesh: bool = Field(False, description="the surface of all that stands still")
    events: bool = Field(False, description="faults, kidnappings and lamps, when each begins and ends")
