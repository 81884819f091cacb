"""Rig: the cameras of a robot in a randomised world, with their poses, lenses and flaws."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic.recorded_camera import RecordedCamera
from monoforce_ros.synthetic.sensors import CameraSettings
from monoforce_ros.synthetic.varied.imaging import Imaging
from monoforce_ros.synthetic.varied.settings import ImagingSettings, RigSettings
from monoforce_ros.synthetic.vehicle import Vehicle

# Wider lenses are fisheyes: a perspective image would be stretched beyond use.
_WIDEST = {"pinhole": math.radians(120), "plumb_bob": math.radians(110), "rational_polynomial": math.radians(110)}
_AHEAD_SPREAD = math.radians(20)
_MARGIN = 0.04
# The optical frame's axes in a body frame that looks along x.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def draw_rig(
    settings: RigSettings, imaging: ImagingSettings, robot: Vehicle, random: np.random.Generator
) -> tuple[RecordedCamera, ...]:
    """Mount cameras on a robot; each has its own pose, lens and imaging.

    Args:
        settings: ranges of numbers, poses and lenses.
        imaging: ranges of exposure, noise and other flaws.
        robot: carries the cameras; they are outside its body.
        random: generator of all of it.
    """
    count = int(settings.count.draw(random))
    size, rate = settings.size.draw(random), settings.rate.draw(random)
    width, height = (int(part) for part in size.split("x"))
    looks_ahead = settings.ahead.draw(random)
    cameras = []
    for index in range(count):
        drawn = settings.draw(random)
        if settings.yaw.low == settings.yaw.high:
            yaw = drawn.yaw
        elif index == 0 and looks_ahead:
            yaw = float(np.clip(random.normal(0.0, _AHEAD_SPREAD), settings.yaw.low, settings.yaw.high))
        else:
            yaw = drawn.yaw
        pose = _pose(robot, drawn.height, yaw, drawn.pitch, drawn.roll, drawn.body)
        flaws = imaging.draw(random)
        shape = (height, width) if drawn.portrait else (width, height)
        camera = _camera(shape, drawn.field_of_view, drawn.lens, drawn.distortion, rate, flaws.quality, random)
        effects = Imaging(flaws, camera.width, camera.height, np.random.default_rng(random.integers(2**63)))
        cameras.append(RecordedCamera(f"camera_{index}", pose, camera, effects.apply))
    return tuple(cameras)


def _camera(
    shape: tuple[int, int], field_of_view: float, lens: str, strength: float, rate: float, quality: int,
    random: np.random.Generator,
) -> CameraSettings:  # fmt: skip
    """Settings of a camera whose field of view lies along its longer side."""
    width, height = shape
    if field_of_view > _WIDEST.get(lens, math.inf):
        lens = "equidistant"
    if width >= height:
        horizontal = field_of_view
    elif lens == "equidistant":
        horizontal = field_of_view * width / height
    else:
        horizontal = 2.0 * math.atan(math.tan(field_of_view / 2) * width / height)
    signs = random.uniform(-1.0, 1.0, 3)
    model = "plumb_bob" if lens == "pinhole" else lens
    for _ in range(12):
        tangential = (0.002 * strength * signs[0], 0.002 * strength * signs[1])
        barrel = -1.0 if signs[2] < 0.7 else 0.4
        distortion: tuple[float, ...] = {
            "pinhole": (),
            "plumb_bob": (0.26 * strength * barrel, 0.07 * strength, *tangential, 0.0),
            "rational_polynomial": (
                0.2 * strength * barrel, 0.05 * strength, *tangential, 0.0, 0.05 * strength, 0.01 * strength, 0.0
            ),
            "equidistant": (0.04 * strength * signs[0], 0.01 * strength * signs[1], 0.0, 0.0),
        }[lens]  # fmt: skip
        try:
            return CameraSettings(
                width=width, height=height, field_of_view=horizontal, rate=rate, quality=quality,
                distortion=distortion, distortion_model=model, oversampling=1,
            )  # fmt: skip
        except ValueError:
            # The distortion folds this wide an image: a weaker one does not.
            strength *= 0.7
    raise ValueError(
        f"rig: no {lens} distortion was found for a field of view of {math.degrees(field_of_view):.0f} degrees; "
        "expected a smaller rig.field_of_view or rig.distortion"
    )


def _pose(robot: Vehicle, height: float, yaw: float, pitch: float, roll: float, body: bool) -> np.ndarray:
    """Pose ``[4, 4]``, base ← camera: at the edge of the robot, or above it with its body in view."""
    corners = [centre[:2] + sign * size[:2] / 2 for centre, size in robot.hull for sign in (-1, 1)]
    corners += [wheel.centre[:2] + sign * wheel.radius for wheel in robot.wheels for sign in (-1, 1)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    top = max((centre[2] + size[2] / 2 for centre, size in robot.hull), default=0.0)
    direction = np.array([math.cos(yaw), math.sin(yaw)])
    limits = np.where(direction >= 0.0, high, -low) + _MARGIN
    to_edge = float((limits / np.maximum(np.abs(direction), 1e-6)).min())
    z = height - robot.clearance
    offset = -0.4 * to_edge if body and z > top + 0.08 else to_edge
    pose = np.eye(4)
    pose[:3, 3] = [*(offset * direction), z]
    turn = Rotation.from_euler("ZYX", [yaw, -pitch, roll]).as_matrix()
    pose[:3, :3] = turn @ _OPTICAL
    return pose
