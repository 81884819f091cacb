"""Overlay of a prediction on a camera image: height map as a surface, path as a ribbon, forces as arrows."""

from __future__ import annotations

import cv2
import numpy as np
from matplotlib import colormaps

from monoforce_ros.core import CameraModel, transform_points
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

SURFACE_COLOURS = "viridis"
PATH_COLOUR = (255, 176, 32)
FORCE_COLOUR = (232, 40, 90)
_NEAREST = 0.35
"""Smallest distance of drawn cells from the camera [m]."""


def draw_prediction(
    image: np.ndarray,
    camera: CameraModel,
    base_from_camera: np.ndarray,
    view: PredictionView,
    robot: RobotModel,
    *,
    width: int = 1280,
    colour_range: tuple[float, float],
) -> np.ndarray:
    """Camera image with the predicted height map, path and forces projected into it.

    Args:
        image: RGB ``[height, width, 3]``.
        camera: its model.
        base_from_camera: pose of the camera on the robot ``[4, 4]``.
        view: prediction to draw.
        width: width of the result [px].
        colour_range: heights at the two ends of the colour scale [m], terrain frame.

    Returns:
        RGB ``[height', width, 3]``.
    """
    height = round(width * camera.height / camera.width)
    canvas = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
    camera = camera.resized(width, height)
    camera_from_terrain = np.linalg.inv(view.motion.terrain_from_base @ base_from_camera)
    canvas = _draw_surface(canvas, camera, camera_from_terrain, view.terrain, colour_range)
    canvas = _draw_path(canvas, camera, camera_from_terrain, view, robot)
    return _draw_forces(canvas, camera, camera_from_terrain, view)


def _project(camera: CameraModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels ``[n, 2]`` of points in the camera frame, including a margin around the image, and which are valid."""
    # A larger virtual sensor keeps polygons complete that cross the border of the image.
    margin = 0.5
    wide = CameraModel(
        int(camera.width * (1 + 2 * margin)),
        int(camera.height * (1 + 2 * margin)),
        camera.matrix + np.array([[0, 0, margin * camera.width], [0, 0, margin * camera.height], [0, 0, 0]]),
        camera.distortion,
        camera.distortion_model,
    )
    target = camera if camera.is_distorted else wide
    pixels, inside = target.project(points)
    return (pixels if camera.is_distorted else pixels - [margin * camera.width, margin * camera.height]), inside


def _draw_surface(
    canvas: np.ndarray,
    camera: CameraModel,
    camera_from_terrain: np.ndarray,
    terrain: TerrainMap,
    colour_range: tuple[float, float],
) -> np.ndarray:
    x, y = np.meshgrid(terrain.grid.x, terrain.grid.y)
    z = terrain.height.double().numpy()
    points = transform_points(camera_from_terrain, np.stack([x, y, z], axis=-1).reshape(-1, 3))
    pixels, usable = _project(camera, points)
    shape = z.shape
    pixels, usable, depth = pixels.reshape(*shape, 2), usable.reshape(shape), points[:, 2].reshape(shape)
    corners = [(slice(None, -1), slice(None, -1)), (slice(None, -1), slice(1, None))]
    corners += [(slice(1, None), slice(1, None)), (slice(1, None), slice(None, -1))]
    quads = np.stack([pixels[c] for c in corners], axis=2)
    drawable = np.all([usable[c] & (depth[c] > _NEAREST) for c in corners], axis=0)
    distance = np.mean([depth[c] for c in corners], axis=0)
    mean_height = np.mean([z[c] for c in corners], axis=0)
    observed = np.mean([terrain.observed.numpy()[c] for c in corners], axis=0) >= 0.5
    low, high = colour_range
    colours = colormaps[SURFACE_COLOURS](np.clip((mean_height - low) / (high - low), 0, 1))[..., :3]
    # Shading by slope makes shapes visible at nearly constant colour.
    slope_y, slope_x = np.gradient(z, terrain.grid.resolution)
    light = (1.0 - 0.6 * slope_x - 0.4 * slope_y)[:-1, :-1] / np.sqrt(1 + slope_x**2 + slope_y**2)[:-1, :-1]
    colours = np.clip(colours * np.clip(0.35 + 0.65 * light, 0.25, 1.15)[..., None], 0, 1) * 255
    layer = canvas.copy()
    weight = np.zeros(canvas.shape[:2], np.float32)
    rows, columns = np.nonzero(drawable)
    # Painter's algorithm: far cells first.
    for index in np.argsort(-distance[rows, columns]):
        row, column = rows[index], columns[index]
        quad = np.rint(quads[row, column] * 8).astype(np.int32)
        cv2.fillConvexPoly(layer, quad, colours[row, column].tolist(), cv2.LINE_AA, shift=3)
        cv2.fillConvexPoly(weight, quad, 0.5 if observed[row, column] else 0.28, cv2.LINE_8, shift=3)
        if row % 5 == 0 or column % 5 == 0:
            edge = quad[[0, 1]] if row % 5 == 0 else quad[[0, 3]]
            cv2.polylines(layer, [edge], False, (colours[row, column] * 0.45).tolist(), 1, cv2.LINE_AA, shift=3)
    opacity = cv2.GaussianBlur(weight, (5, 5), 0)[..., None]
    return np.rint(layer * opacity + canvas * (1 - opacity)).astype(np.uint8)


def _draw_path(
    canvas: np.ndarray, camera: CameraModel, camera_from_terrain: np.ndarray, view: PredictionView, robot: RobotModel
) -> np.ndarray:
    stride = max(1, round(0.05 / (view.times[1] - view.times[0]))) if len(view.times) > 1 else 1
    times, positions, rotations = (values[::stride] for values in (view.times, view.positions, view.rotations))
    half_width = float(robot.points[:, 1].abs().max())
    edges = []
    for side in (half_width, 0.0, -half_width):
        offset = np.array([0.0, side, -robot.ground_clearance])
        pixels, usable = _project(camera, transform_points(camera_from_terrain, positions + rotations @ offset))
        edges.append((pixels, usable))
    (left, left_ok), (centre, centre_ok), (right, right_ok) = edges
    layer = canvas.copy()
    for i in range(len(times) - 1):
        if left_ok[i] and left_ok[i + 1] and right_ok[i] and right_ok[i + 1]:
            quad = np.rint(np.array([left[i], left[i + 1], right[i + 1], right[i]]) * 8).astype(np.int32)
            cv2.fillConvexPoly(layer, quad, PATH_COLOUR, cv2.LINE_AA, shift=3)
    canvas = cv2.addWeighted(layer, 0.35, canvas, 0.65, 0)
    for pixels, usable in ((left, left_ok), (right, right_ok), (centre, centre_ok)):
        line = np.rint(pixels[usable] * 8).astype(np.int32)
        if len(line) > 1:
            cv2.polylines(canvas, [line], False, PATH_COLOUR, 3, cv2.LINE_AA, shift=3)
    for second in range(1, int(times[-1] + 1e-6) + 1):
        index = int(np.argmin(np.abs(times - second)))
        if centre_ok[index]:
            place = tuple(int(v) for v in np.rint(centre[index]))
            cv2.circle(canvas, place, 9, (20, 40, 60), -1, cv2.LINE_AA)
            cv2.circle(canvas, place, 6, (255, 255, 255), -1, cv2.LINE_AA)
            text = f"{second} s"
            cv2.putText(canvas, text, (place[0] + 13, place[1] + 6), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 4, 16)
            cv2.putText(
                canvas, text, (place[0] + 13, place[1] + 6), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, 16
            )
    return canvas


def _draw_forces(
    canvas: np.ndarray, camera: CameraModel, camera_from_terrain: np.ndarray, view: PredictionView
) -> np.ndarray:
    tips = view.contact_points + view.drawn_forces
    lower, lower_ok = _project(camera, transform_points(camera_from_terrain, view.contact_points))
    upper, upper_ok = _project(camera, transform_points(camera_from_terrain, tips))
    for start, end in zip(lower[lower_ok & upper_ok], upper[lower_ok & upper_ok], strict=True):
        tail, tip = ((int(x), int(y)) for x, y in np.rint([start, end]))
        cv2.arrowedLine(canvas, tail, tip, FORCE_COLOUR, 2, cv2.LINE_AA, tipLength=0.2)
    return canvas
