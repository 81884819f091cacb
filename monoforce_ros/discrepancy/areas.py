"""Areas: parts of the ground in which effects may act, as masks of a recording's windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.stats import rankdata

from monoforce_ros.core import transform_points
from monoforce_ros.discrepancy.evidence import EvidenceWindows, Place, sample_motion
from monoforce_ros.discrepancy.preflight import FEWEST_WINDOWS
from monoforce_ros.discrepancy.trial import BLOCK, blocks_of
from monoforce_ros.robots import RobotModel

_FEWEST_BLOCKS = 3
"""Half blocks within and outside an area: fewer do not show that anything differs."""
_SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Shares of the windows that circles hold."""
_MOST_CENTRES = 60
"""Centres of circles, spread over the path: half of a diagnosis' windows, which begin a second apart, so that
neighbours overlap. It only saves time."""
_CLUSTERS = 3
"""Places that are tested without a scan."""


@dataclass(frozen=True)
class Circle:
    """A circle on the ground, in the odometry frame."""

    x: float
    """[m]."""
    y: float
    """[m]."""
    radius: float
    """[m]."""

    @property
    def words(self) -> str:
        """Where it is, after "it acts"."""
        return f"within {self.radius:.1f} m of ({self.x:.1f}, {self.y:.1f}) in the odometry frame"

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Its lowest and highest corner, ``[2]`` each [m]."""
        return np.array([self.x, self.y]) - self.radius, np.array([self.x, self.y]) + self.radius

    def contains(self, data: EvidenceWindows) -> np.ndarray:
        """Windows of any length whose middle lies in it, ``[W]`` bool."""
        return self.holds(window_places(data), data)

    def holds(self, places: np.ndarray, data: EvidenceWindows) -> np.ndarray:
        """Places ``[N, 2]`` [m] in it, ``[N]`` bool."""
        return np.linalg.norm(places - np.array([self.x, self.y]), axis=1) <= self.radius


@dataclass(frozen=True)
class GroundClass:
    """Ground on which a channel of the map is above a value, or not."""

    channel: str
    """``vegetation`` or ``friction``."""
    cut: float
    above: bool

    @property
    def words(self) -> str:
        """Where it is, after "it acts"."""
        words, unit, _ = _CHANNELS[self.channel]
        return f"{'where' if self.above else 'except where'} {words} {self.cut:.2f}{unit}"

    @property
    def bounds(self) -> None:
        """It is as large as the map."""
        return None

    def contains(self, data: EvidenceWindows) -> np.ndarray:
        """Windows of any length that lie on it by their mean, ``[W]`` bool."""
        return (_along(data, self.channel) > self.cut) == self.above

    def holds(self, places: np.ndarray, data: EvidenceWindows) -> np.ndarray:
        """Places ``[N, 2]`` [m] in the odometry frame on it, ``[N]`` bool; heights of the robot do not matter."""
        at_height = np.c_[places, np.full(len(places), float(data.motion.positions[:, 2].mean()))]
        return (_values_at(data, self.channel, at_height) > self.cut) == self.above


_CHANNELS = {
    "vegetation": ("the vegetation is taller than", " m", 0.05),
    "friction": ("the map's friction is above", "", 0.1),
}
"""Words, unit and least difference of the means of two classes: half a cell of a map [m]; friction on one ground."""


@dataclass(frozen=True)
class Area:
    """A part of the ground, and the windows of a recording in it."""

    inside: np.ndarray
    """``[W]`` bool."""
    place: Circle | GroundClass

    @property
    def visits(self) -> int:
        """How often the robot came into it."""
        return int(self.inside[0]) + int((np.diff(self.inside.astype(int)) > 0).sum())


def window_places(data: EvidenceWindows) -> np.ndarray:
    """Position in the odometry frame in the middle of each window, ``[W, 2]`` [m]."""
    return sample_motion(data.motion, data.starts + round(0.5e9 * data.horizon))[0][:, :2]


def ground_classes(data: EvidenceWindows) -> list[Area]:
    """Windows on either class of ground, where a map tells two apart: by depth of vegetation, and by friction."""
    if data.terrain is None:
        return []
    found = []
    for channel, (_, _, least) in _CHANNELS.items():
        values = _along(data, channel)
        cut, difference = _cut(values)
        if difference >= least:
            found += [Area((values > cut) == above, GroundClass(channel, cut, above)) for above in (True, False)]
    return [area for area in found if _large_enough(area, data)]


def shows_vegetation(data: EvidenceWindows) -> bool:
    """Whether the robot drove through vegetation that the map holds: in as many windows as a class of ground needs."""
    if data.terrain is None:
        return False
    return _enough(_along(data, "vegetation") > _CHANNELS["vegetation"][2], data)


def _along(data: EvidenceWindows, channel: str) -> np.ndarray:
    """Mean of a channel of the map along the path of each window, ``[W]``."""
    positions = paths_of(data)
    return _values_at(data, channel, positions.reshape(-1, 3)).reshape(positions.shape[:2]).mean(axis=1)


def _values_at(data: EvidenceWindows, channel: str, positions: np.ndarray) -> np.ndarray:
    """A channel of the map at positions ``[N, 3]`` in the odometry frame, ``[N]``."""
    if data.terrain is None or data.odometry_from_terrain is None:
        raise ValueError("classes of ground: got no terrain map, expected one with its pose in the odometry frame")
    on_map = transform_points(np.linalg.inv(data.odometry_from_terrain), positions)
    terrain = data.terrain
    rows, columns, _ = terrain.grid.cells(on_map[:, :2])
    values = terrain.friction if channel == "friction" else terrain.geometric_height - terrain.height
    return values.double().numpy()[rows, columns]


def paths_of(data: EvidenceWindows) -> np.ndarray:
    """Positions in the odometry frame during each window, ``[W, 11, 3]`` [m]."""
    times = data.starts[:, None] + np.rint(np.linspace(0.0, data.horizon, 11) * 1e9).astype(np.int64)
    return sample_motion(data.motion, times)[0]


def touching(place: Place, data: EvidenceWindows, reach: float) -> np.ndarray:
    """Windows of any length in which a robot is on a part of the ground with any of its wheels, ``[W]`` bool.

    Args:
        place: the part.
        data: the windows.
        reach: distance of the robot's farthest point from its base [m].
    """
    return touched(place, swept(data, reach), data)


def touched(place: Place, points: np.ndarray, data: EvidenceWindows) -> np.ndarray:
    """Windows with any of their points ``[W, N, 2]`` [m] on a part of the ground, ``[W]`` bool."""
    return place.holds(points.reshape(-1, 2), data).reshape(len(points), -1).any(axis=1)


def swept(data: EvidenceWindows, reach: float) -> np.ndarray:
    """Places in the odometry frame where any of a robot's wheels may be in each window, ``[W, N, 2]`` [m]."""
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    around = np.concatenate([np.zeros((1, 2)), reach * np.column_stack([np.cos(angles), np.sin(angles)])])
    return (paths_of(data)[:, :, None, :2] + around).reshape(len(data.starts), -1, 2)


def reach_of(robot: RobotModel) -> float:
    """Distance of a robot's farthest point from its base, as seen from above [m]."""
    return float(robot.points[:, :2].norm(dim=1).max())


def circles(data: EvidenceWindows) -> list[Area]:
    """Circles of several sizes about places of the recording."""
    places = window_places(data)
    picked = np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_CENTRES)).round().astype(int))
    listed = []
    for centre in places[picked]:
        distance = np.linalg.norm(places - centre, axis=1)
        for radius in np.quantile(distance, _SHARES):
            listed.append(_circle(places, centre, float(radius), data))
    return [area for area in listed if _large_enough(area, data)]


def clusters(data: EvidenceWindows) -> list[Area]:
    """Classes of ground, and a few places that divide the recording: areas to be tested without a scan."""
    places = window_places(data)
    _, label = kmeans2(places, _CLUSTERS, minit="++", seed=0)
    listed = []
    for number in np.unique(label):
        centre = places[label == number].mean(axis=0)
        radius = float(np.quantile(np.linalg.norm(places[label == number] - centre, axis=1), 0.9))
        listed.append(_circle(places, centre, radius, data))
    return [*ground_classes(data), *(area for area in listed if _large_enough(area, data))]


def worst_place(data: EvidenceWindows, losses: np.ndarray, rate: float) -> Area | None:
    """The place with the largest losses, to which the robot came at least twice; None where none stands out.

    Losses are compared by their ranks, and with how they would lie on the ground if they had occurred earlier or later
    in the drive: shifts in time keep how losses follow one another, and how places do.

    Args:
        data: the windows.
        losses: of each window, ``[W]``.
        rate: error rate, for all places together.
    """
    areas = [area for area in circles(data) if area.visits > 1]
    if not areas:
        return None
    masks = np.array([area.inside for area in areas], float)
    counts = masks.sum(axis=1)
    ranks = rankdata(losses) - 0.5 * (len(losses) + 1)
    nearest = round(BLOCK / max(float(np.median(np.diff(data.starts))) * 1e-9, 1e-3))
    shifts = [0, *range(nearest, len(losses) - nearest + 1)]
    shifted = np.stack([np.roll(ranks, shift) for shift in shifts])
    statistics = (shifted @ masks.T) / np.sqrt(counts * (1.0 - counts / len(losses)))
    largest = statistics.max(axis=1)
    p = float((largest >= largest[0]).mean())
    return areas[int(np.argmax(statistics[0]))] if p <= rate else None


def _circle(places: np.ndarray, centre: np.ndarray, radius: float, data: EvidenceWindows) -> Area:
    circle = Circle(float(centre[0]), float(centre[1]), radius)
    return Area(circle.holds(places, data), circle)


def _large_enough(area: Area, data: EvidenceWindows) -> bool:
    return _enough(area.inside, data) and _block_count(~area.inside, data) >= _FEWEST_BLOCKS


def _enough(chosen: np.ndarray, data: EvidenceWindows) -> bool:
    """Whether windows ``[W]`` bool suffice to show what is special about them."""
    return _block_count(chosen, data) >= _FEWEST_BLOCKS and int(chosen.sum()) >= FEWEST_WINDOWS


def _block_count(chosen: np.ndarray, data: EvidenceWindows) -> int:
    return len(np.unique(blocks_of(data.starts)[chosen]))


def _cut(values: np.ndarray) -> tuple[float, float]:
    """Value that divides others into two classes of the largest variance between them (Otsu 1979), and the difference
    of their means."""
    ordered = np.sort(values)
    count = np.arange(1, len(ordered))
    sums = np.cumsum(ordered)
    low, high = sums[:-1] / count, (sums[-1] - sums[:-1]) / (len(ordered) - count)
    best = int(np.argmax(count * (len(ordered) - count) * (high - low) ** 2))
    return float(0.5 * (ordered[best] + ordered[best + 1])), float(high[best] - low[best])
