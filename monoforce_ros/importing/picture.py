"""Picture of a robot: body points, wheels, tracks, hull and sensors, from the side, from above and in space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from monoforce_ros.robots import RobotModel

# Colours that stay apart for colour-blind readers (Okabe and Ito), and greys for the body.
_LEFT, _RIGHT, _OTHER, _FREE = "#0072b2", "#d55e00", "#009e73", "#8a8a8a"
_CAMERA, _LIDAR, _IMU, _CENTRE = "#cc79a7", "#b58900", "#56b4e9", "#111111"
_HULL_EDGE, _HULL_FACE, _GROUND = "#5a6570", "#c9d1d9", "#8d7b62"
_FIELD_OF_VIEW = np.radians([35.0, 25.0])
"""Half of the drawn angles across and up: a picture of where a camera looks, not its calibration."""


def draw_robot(robot: RobotModel, content: Mapping[str, Any]) -> Figure:
    """Draw a robot.

    Args:
        robot: the robot as loaded.
        content: the content of its file, for the shapes of wheels, tracks and hull.
    """
    figure = Figure(figsize=(15.0, 7.6), dpi=110, layout="constrained", facecolor="white")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.25, 1.0], height_ratios=[1.0, 1.15])
    space = figure.add_subplot(grid[:, 0], projection="3d")
    side, above = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    drawing = _Drawing(robot, content)
    drawing.flat(side, (0, 2))
    drawing.flat(above, (0, 1))
    drawing.space(space)
    side.set_title("from the right side", fontsize=11)
    above.set_title("from above", fontsize=11)
    drive = content.get("drive", {}).get("kind", "skid").replace("_", " ")
    low, high = (bound.numpy() for bound in robot.bounds)
    length, width, height = high - low
    figure.suptitle(
        f"{robot.name}: {float(robot.mass):.4g} kg, {length:.2f} × {width:.2f} × {height:.2f} m, {drive} drive, "
        f"{len(robot.points)} body points",
        fontsize=14,
    )
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=8, frameon=False, fontsize=10, markerscale=1.3)
    return figure


class _Drawing:
    def __init__(self, robot: RobotModel, content: Mapping[str, Any]):
        self.robot, self.content = robot, content
        self.points = robot.points.double().numpy()
        self.drives = robot.point_drives.numpy()
        self.sensors = {name: pose.double().numpy() for name, pose in robot.sensors.items()}
        self.centre = robot.centre_of_mass.double().numpy()
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        self.ground = float(self.points[self.drives >= 0][:, 2].min()) if (self.drives >= 0).any() else float(low[2])
        places = np.array([pose[:3, 3] for pose in self.sensors.values()] or [self.centre])
        self.low, self.high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
        self.low[2] = min(self.low[2], self.ground)
        self.size = float((self.high - self.low).max())

    def colour(self, drive: str | None, y: float) -> str:
        """Colour of a wheel: by its side if its drive has one."""
        if drive is None:
            return _FREE
        return {"left": _LEFT, "right": _RIGHT}.get(drive, _OTHER if abs(y) < 1e-3 else _LEFT if y > 0 else _RIGHT)

    def belts(self) -> list[tuple[np.ndarray, float, str]]:
        """Outline ``[n, 3]`` [m] in the plane of the middle, width and colour of wheels, tracks and flippers."""
        found = []
        for wheel in self.content.get("wheels", []):
            centre, radius = np.array(wheel["centre"], float), float(wheel["radius"])
            outline = _loop(centre, radius, centre, radius)
            found.append((outline, float(wheel["width"]), self.colour(wheel.get("drive"), centre[1])))
        for track in self.content.get("tracks", []):
            centre, half = np.array(track["centre"], float), np.array([float(track["length"]) / 2, 0.0, 0.0])
            outline = _loop(centre - half, float(track["radius"]), centre + half, float(track["radius"]))
            found.append((outline, float(track["width"]), self.colour(track["drive"], centre[1])))
        for flipper in self.content.get("flippers", []):
            joint, angle = np.array(flipper["joint"], float), float(flipper["angle"])
            ahead = 1.0 if flipper["end"] == "front" else -1.0
            tip = joint + float(flipper["length"]) * np.array([ahead * np.cos(angle), 0.0, np.sin(angle)])
            outline = _loop(joint, float(flipper["root_radius"]), tip, float(flipper["tip_radius"]))
            found.append((outline, float(flipper["width"]), self.colour(flipper["drive"], joint[1])))
        return found

    def kind(self, name: str) -> tuple[str, str]:
        """Colour and label of a sensor."""
        lowered = name.lower()
        if "imu" in lowered:
            return _IMU, "IMU"
        if any(word in lowered for word in ("lidar", "laser", "velodyne", "ouster", "os_", "scan", "hesai", "livox")):
            return _LIDAR, "lidar"
        return _CAMERA, "camera"

    def frustum(self, pose: np.ndarray) -> np.ndarray:
        """Tip and far corners of a camera's view ``[5, 3]`` [m] in the base frame."""
        reach = 0.22 * self.size
        right, down = reach * np.tan(_FIELD_OF_VIEW)
        corners = np.array(
            [[0, 0, 0], *[[sx * right, sy * down, reach] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]]
        )
        return corners @ pose[:3, :3].T + pose[:3, 3]

    def flat(self, axes: Axes, chosen: tuple[int, int]) -> None:
        """A projection onto two axes of the base frame."""
        a, b = chosen
        for box in self.content.get("hull", []):
            centre, size = np.array(box["centre"], float), np.array(box["size"], float)
            corner = (float(centre[a] - size[a] / 2), float(centre[b] - size[b] / 2))
            axes.add_patch(
                Rectangle(
                    corner, size[a], size[b], facecolor=_HULL_FACE, edgecolor=_HULL_EDGE, linewidth=0.8, alpha=0.55
                )
            )
        for outline, width, colour in self.belts():
            if b == 2:
                axes.add_patch(
                    Polygon(outline[:, [0, 2]], facecolor=colour, edgecolor=colour, alpha=0.28, linewidth=1.4)
                )
            else:
                low, high = float(outline[:, 0].min()), float(outline[:, 0].max())
                start = (low, float(outline[0, 1]) - width / 2)
                axes.add_patch(Rectangle(start, high - low, width, facecolor=colour, edgecolor=colour, alpha=0.28))
        self.dots(axes, a, b)
        if b == 2:
            axes.axhline(self.ground, color=_GROUND, linewidth=1.5, zorder=0)
            axes.axhspan(self.ground - self.size, self.ground, color=_GROUND, alpha=0.12, zorder=0)
        seen = set()
        for name, pose in self.sensors.items():
            colour, label = self.kind(name)
            shown = "_" + label if label in seen else label  # matplotlib leaves out labels that begin with "_"
            seen.add(label)
            if label == "camera":
                corners = self.frustum(pose)[:, [a, b]]
                for pair in ((1, 2), (2, 3), (3, 4), (4, 1)):
                    axes.add_patch(Polygon(corners[[0, *pair]], facecolor=colour, alpha=0.12, edgecolor="none"))
                for far in corners[1:]:
                    axes.plot(*zip(corners[0], far, strict=True), color=colour, linewidth=0.9)
            axes.plot(
                *pose[[a, b], 3], "s" if label == "camera" else "D", color=colour, markersize=7, zorder=5, label=shown
            )
        axes.plot(*self.centre[[a, b]], "o", color="white", markeredgecolor=_CENTRE, markersize=11, zorder=6)
        axes.plot(*self.centre[[a, b]], "+", color=_CENTRE, markersize=11, zorder=7, label="centre of mass")
        self.steering(axes, b)
        margin = 0.12 * self.size
        # Arcs of steered wheels reach beyond the body.
        beyond = margin * (2 if b == 1 and self.content.get("steering") else 1)
        axes.set(
            xlim=(self.low[0] - margin, self.high[0] + 2 * margin), ylim=(self.low[b] - beyond, self.high[b] + beyond),
            aspect="equal", xlabel="x [m]", ylabel="z [m]" if b == 2 else "y [m]",
        )  # fmt: skip
        for edge in ("top", "right"):
            axes.spines[edge].set_visible(False)

    def dots(self, axes: Axes, a: int, b: int) -> None:
        """Body points of the hull, then of the drives, so that these lie on top."""
        hull, seen = self.drives < 0, set[str]()
        free = {wheel["name"] for wheel in self.content.get("wheels", []) if wheel.get("drive") is None}
        axes.plot(*self.points[hull][:, [a, b]].T, ".", color=_HULL_EDGE, markersize=2.2, label="hull")
        for index, name in enumerate(self.robot.drive_names):
            chosen = self.points[self.drives == index]
            if not len(chosen):
                continue
            colour = self.colour(None if name in free else name, float(np.sign(np.round(chosen[:, 1].mean(), 3))))
            label = {_LEFT: "driven, left", _RIGHT: "driven, right", _FREE: "rolls freely"}.get(colour, "driven")
            shown = "_" + label if label in seen else label
            seen.add(label)
            axes.plot(*chosen[:, [a, b]].T, ".", color=colour, markersize=2.6, label=shown)

    def steering(self, axes: Axes, b: int) -> None:
        """Arcs over which steered wheels and casters turn, seen from above."""
        if b == 2:
            for rocker in self.content.get("rockers", []):
                axes.add_patch(
                    Circle((rocker["pivot"][0], rocker["pivot"][2]), 0.02 * self.size, fill=False, color=_OTHER, lw=2)
                )
            return
        wheels = {wheel["name"]: wheel for wheel in self.content.get("wheels", [])}
        for entry in self.content.get("steering", []):
            wheel, limit = wheels[entry["wheel"]], float(entry["maximum_angle"])
            angles = np.linspace(-limit, limit, 20)
            reach = 1.35 * float(wheel["radius"])
            axes.plot(
                wheel["centre"][0] + reach * np.cos(angles),
                wheel["centre"][1] + reach * np.sin(angles),
                color=_OTHER,
                lw=2,
            )
        for entry in self.content.get("casters", []):
            pivot, centre = np.array(entry["pivot"], float), np.array(wheels[entry["wheel"]]["centre"], float)
            trail = float(np.linalg.norm((centre - pivot)[:2]))
            axes.add_patch(Circle((float(pivot[0]), float(pivot[1])), trail, fill=False, color=_OTHER, linestyle="--"))

    def space(self, axes: Any) -> None:
        """The robot in space."""
        for box in self.content.get("hull", []):
            centre, size = np.array(box["centre"], float), np.array(box["size"], float)
            faces = Poly3DCollection(
                _box_faces(centre, size), facecolor=_HULL_FACE, edgecolor=_HULL_EDGE, alpha=0.35, lw=0.7
            )
            axes.add_collection3d(faces)
        for outline, width, colour in self.belts():
            across = np.array([0.0, width / 2, 0.0])
            near, far = outline - across, outline + across
            bands = [np.array([near[i], near[i + 1], far[i + 1], far[i]]) for i in range(len(outline) - 1)]
            axes.add_collection3d(Poly3DCollection([near, far], facecolor=colour, edgecolor=colour, alpha=0.35, lw=0.8))
            axes.add_collection3d(Poly3DCollection(bands, facecolor=colour, edgecolor="none", alpha=0.22))
        hull = self.drives < 0
        axes.scatter(*self.points[hull].T, s=1.2, color=_HULL_EDGE, depthshade=False)
        for index, name in enumerate(self.robot.drive_names):
            chosen = self.points[self.drives == index]
            if len(chosen):
                colour = self.colour(name, float(np.sign(np.round(chosen[:, 1].mean(), 3))))
                axes.scatter(*chosen.T, s=2.0, color=colour, depthshade=False)
        for name, pose in self.sensors.items():
            colour, label = self.kind(name)
            if label == "camera":
                corners = self.frustum(pose)
                faces = [corners[[0, *pair]] for pair in ((1, 2), (2, 3), (3, 4), (4, 1))]
                axes.add_collection3d(Poly3DCollection(faces, facecolor=colour, edgecolor=colour, alpha=0.15, lw=0.8))
            axes.scatter(*pose[:3, 3], s=45, color=colour, marker="s" if label == "camera" else "D", depthshade=False)
        axes.scatter(*self.centre, s=90, color=_CENTRE, marker="+", depthshade=False)
        reach = 0.52 * self.size
        x, y = (self.low[0] + self.high[0]) / 2, (self.low[1] + self.high[1]) / 2
        ground = [[x - reach, y - reach], [x + reach, y - reach], [x + reach, y + reach], [x - reach, y + reach]]
        plane = [[*corner, self.ground] for corner in ground]
        axes.add_collection3d(Poly3DCollection([plane], facecolor=_GROUND, edgecolor="none", alpha=0.12))
        arrow = 0.25 * self.size
        axes.quiver(0, 0, 0, arrow, 0, 0, color=_CENTRE, lw=1.4)
        half = 0.55 * self.size
        middle = (self.low + self.high) / 2
        axes.set(
            xlim=(x - half, x + half), ylim=(y - half, y + half), zlim=(middle[2] - half * 0.7, middle[2] + half * 0.7)
        )
        axes.set_box_aspect((1, 1, 0.7), zoom=1.1)
        axes.view_init(elev=24, azim=-52)
        axes.set_axis_off()


def _loop(rear: np.ndarray, rear_radius: float, front: np.ndarray, front_radius: float) -> np.ndarray:
    """Closed convex outline around two circles in the plane across y, ``[n, 3]`` [m]."""
    angles = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
    ring = np.stack([np.cos(angles), np.zeros_like(angles), np.sin(angles)], axis=1)
    points = np.concatenate([rear + rear_radius * ring, front + front_radius * ring])
    # The farthest point in each direction belongs to the hull of both circles.
    reach = points @ ring.T
    outline = points[reach.argmax(axis=0)]
    return np.concatenate([outline, outline[:1]])


def _box_faces(centre: np.ndarray, size: np.ndarray) -> list[np.ndarray]:
    signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    faces = []
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        for side in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, first], corners[:, second] = np.array(signs, float).T
            faces.append(centre + corners * size / 2)
    return faces
