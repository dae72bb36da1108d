"""Calibrations, images, depth."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import (
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Image,
    Image16,
    RelativeDepth,
)
from dataflow.video.decoder import PacketDecoder
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer

_DEPTH_COLORS = rr.components.Colormap.Turbo
_FAR = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0)
"""Ends of the scale of depths, metres."""
_SHADES = 32
_PNG_LEVEL = 6  # more takes twice the time for two hundredths of the size


@visualizer(CameraInfo, "image")
def camera_info(canvas: Canvas, message: CameraInfo) -> None:
    """A frustum in the optical frame; images and overlays of this camera lie in its plane. Distortion is not shown."""
    canvas.scene.viewpoint.optical.setdefault(message.frame)
    canvas.scene.see(canvas.recording, message.frame, canvas.stamp)
    pinhole = rr.Pinhole(
        image_from_camera=message.K,
        resolution=[message.width, message.height],
        parent_frame=message.frame,
        child_frame=canvas.plane,
        image_plane_distance=0.3,
        color=colors.NEUTRAL,
    )
    canvas.log("", pinhole)


@visualizer(Image, "image")
def image(canvas: Canvas, message: Image) -> None:
    """The image, as JPEG unless the options say otherwise."""
    if message.data.size == 0:
        canvas.clear("")
        return
    picture = _picture(message.data)
    quality = canvas.scene.options.jpeg_quality
    canvas.draw("", canvas.plane, picture if quality is None else picture.compress(jpeg_quality=quality))


def _picture(pixels: npt.NDArray[np.uint8]) -> rr.Image:
    """Pixels (H, W, 3) or (H, W); not from the array itself: of that, Rerun drops extents of 1."""
    height, width, *colored = pixels.shape
    model = rr.ColorModel.RGB if colored else rr.ColorModel.L
    return rr.Image(bytes=pixels.tobytes(), width=width, height=height, color_model=model, datatype="U8")


@visualizer(Image16, "image")
def image16(canvas: Canvas, message: Image16) -> None:
    """The image in 8 bits, its own first to last percent from dark to bright."""
    low, high = np.percentile(message.data, (1, 99))
    share = np.clip((message.data.astype(np.float32) - low) / max(float(high - low), 1.0), 0, 1)
    image(canvas, Image(stamp=message.stamp, frame=message.frame, data=np.rint(share * 255).astype(np.uint8)))


@visualizer(CompressedImage, "image")
def compressed_image(canvas: Canvas, message: CompressedImage) -> None:
    """The encoded file as it is."""
    encoded = rr.EncodedImage(contents=message.data.tobytes(), media_type=f"image/{message.format}")
    canvas.draw("", canvas.plane, encoded)


@visualizer(CompressedVideo, "image")
def compressed_video(canvas: Canvas, message: CompressedVideo) -> None:
    """The decoded image, the first in each step of the options; nothing where packets are lost, until a key frame."""
    decoder = canvas.scene.videos.get(canvas.stream)
    if decoder is None or decoder.format != message.format:
        decoder = canvas.scene.videos[canvas.stream] = PacketDecoder(message.format)
    pixels = decoder.decode(message.data.tobytes(), message.stamp)
    if pixels is None:
        canvas.notice(f"pictures are not shown until the next key frame: {decoder.lost}")
        canvas.clear("")
        return
    step = canvas.scene.options.image_step
    if step == 0 or canvas.scene.changed(canvas.entity, "step", message.stamp // step):
        image(canvas, Image(stamp=message.stamp, frame=message.frame, data=pixels))


@visualizer(DepthImage, "image")
def depth_image(canvas: Canvas, message: DepthImage) -> None:
    """Colours by distance, and points in space where the camera is calibrated."""
    _depth(canvas, message.data)


@visualizer(CompressedDepth, "image")
def compressed_depth(canvas: Canvas, message: CompressedDepth) -> None:
    """As a depth image; a PNG of values proportional to depth and no finer than asked for is passed on as it is."""
    step, linear = canvas.scene.options.depth_step, message.quantizer == "linear"
    fits = canvas.scene.options.depth_block == 1 and (step is None or message.scale > step / 2)
    if linear and message.offset == 0.0 and fits and (canvas.entity, "depth scale") in canvas.scene.remembered:
        _encoded_depth(canvas, message.data.tobytes(), 1.0 / message.scale)
        return
    values = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError("the PNG of the CompressedDepth cannot be decoded")
    pixels = values.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = message.scale * pixels + message.offset if linear else message.scale / (pixels - message.offset)
    _depth(canvas, np.where(pixels > 0, depth, 0.0).astype(np.float32))


@visualizer(RelativeDepth, "image")
def relative_depth(canvas: Canvas, message: RelativeDepth) -> None:
    """Colours by nearness, from the image's own first to its last percent; in space it has no place."""
    known = np.isfinite(message.data)
    values = message.data[known]
    low, high = np.percentile(values, (1, 99)) if values.size else (0.0, 1.0)
    share = np.clip((np.where(known, message.data, low) - low) / max(float(high - low), 1e-9), 0, 1)
    colored = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    canvas.draw("", canvas.plane, _picture(np.where(known[..., None], colored, 0).astype(np.uint8)))


def _depth(canvas: Canvas, depth: npt.NDArray[np.float32]) -> None:
    if depth.size == 0:
        canvas.clear("")
        return
    known = np.isfinite(depth) & (depth > 0)
    clean = np.where(known, depth, np.float32(0))
    sample = clean[::8, ::8]
    canvas.scene.viewpoint.saw_range(sample[sample > 0])
    if (canvas.entity, "depth scale") not in canvas.scene.remembered and (sample > 0).any():
        _scale(canvas, float(np.percentile(sample[sample > 0], 98)), clean.shape)
    step = canvas.scene.options.depth_step
    if step is None:
        far = canvas.scene.remembered.get((canvas.entity, "depth scale"))
        picture = rr.DepthImage(clean, meter=1.0, colormap=_DEPTH_COLORS, depth_range=None if far is None else (0, far))
        canvas.draw("", canvas.plane, picture)
        return
    farthest = float(clean.max(initial=0.0))
    units = min(1.0 / step, 65000.0 / farthest if farthest > 0 else np.inf)  # per metre
    steps = _in_blocks(np.rint(clean * np.float32(units)).astype(np.uint16), canvas.scene.options.depth_block)
    encoded, png = cv2.imencode(".png", steps, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    if not encoded:
        raise ValueError(f"a depth image of shape {depth.shape} cannot be written as PNG")
    _encoded_depth(canvas, png.tobytes(), units)


def _in_blocks(steps: npt.NDArray[np.uint16], side: int) -> npt.NDArray[np.uint16]:
    """The image in squares that have the value of their first pixel: as large as before, and far easier to pack."""
    if side == 1:
        return steps
    return steps[::side, ::side].repeat(side, 0).repeat(side, 1)[: steps.shape[0], : steps.shape[1]]


def _encoded_depth(canvas: Canvas, png: bytes, units: float) -> None:
    """A depth PNG with `units` steps per metre, in colours that mean the same from the first image to the last."""
    far = canvas.scene.remembered.get((canvas.entity, "depth scale"))
    span = None if far is None else (0.0, far * units)
    picture = rr.EncodedDepthImage(
        blob=png, media_type="image/png", meter=units, colormap=_DEPTH_COLORS, depth_range=span
    )
    canvas.draw("", canvas.plane, picture)


def _scale(canvas: Canvas, far: float, shape: tuple[int, ...]) -> None:
    """Settles for good which depth has the last colour, and draws the bar of colours at the left edge of the image."""
    end = next((nice for nice in _FAR if nice >= far), float(np.ceil(far)))
    canvas.scene.remembered[canvas.entity, "depth scale"] = end
    height, width = shape
    top, bottom, side = 0.08 * height, 0.92 * height, max(width / 40, 3.0)
    cuts = np.linspace(bottom, top, _SHADES + 1)
    column = np.full(_SHADES, 1.5 * side)
    bar = rr.LineStrips2D(
        np.stack([np.column_stack([column, cuts[:-1]]), np.column_stack([column, cuts[1:]])], axis=1),
        colors=colors.of_values(np.arange(_SHADES), 0.0, _SHADES - 1.0),
        radii=side / 2,
        draw_order=5.0,
    )
    canvas.log("scale/bar", rr.CoordinateFrame(canvas.plane), bar, static=True)
    marks = np.linspace(0.0, end, 5)
    points = rr.Points2D(
        np.column_stack([np.full(5, 2.0 * side), bottom - marks / end * (bottom - top)]),
        colors=(235, 235, 235),
        radii=rr.Radius.ui_points(1.5),
        labels=[f"{mark:g} m" for mark in marks],
        show_labels=True,
        draw_order=6.0,
    )
    canvas.log("scale/marks", rr.CoordinateFrame(canvas.plane), points, static=True)
