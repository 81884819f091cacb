"""What Nav2's static layer and speed filter do with the messages that they receive, by their documented rules.

Written for the tests from the behaviour of nav2_costmap_2d: quality of service of the subscription, resizing, values,
and the transfer into a rolling costmap.
"""

from dataclasses import dataclass, field

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

FREE, INSCRIBED, LETHAL, UNKNOWN = 0, 253, 254, 255
_EPSILON = 1e-5


def layer_quality(transient_local: bool) -> QoSProfile:
    """The quality of service that the static layer and the filters subscribe with."""
    if not transient_local:
        return QoSProfile(depth=10)
    return QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass
class StaticLayer:
    """A static layer, in a costmap that rolls with the robot or not."""

    rolling: bool
    trinary: bool
    lethal_threshold: int = 100
    unknown_value: int = 255
    inscribed_value: int = 99
    track_unknown: bool = True
    master: tuple = ()
    """Size, resolution and origin of a costmap that does not roll."""
    resized: list = field(default_factory=list)
    """Each resizing of the whole costmap, which clears its other layers."""
    misaligned: list = field(default_factory=list)
    costs: np.ndarray | None = None

    def take(self, message) -> None:
        """Receive a map."""
        info = message.info
        size = info.width, info.height
        assert len(message.data) == size[0] * size[1], "Nav2 refuses a malformed map"
        origin = info.origin.position.x, info.origin.position.y
        shape = (*size, info.resolution, *origin)
        if not self.rolling and (len(self.master) != 5 or not np.allclose(self.master, shape, rtol=0, atol=_EPSILON)):
            self.resized.append(shape)
            self.master = shape
            for corner in origin:
                remainder = np.fmod(corner, info.resolution)
                if abs(remainder) > _EPSILON and abs(abs(remainder) - info.resolution) > _EPSILON:
                    self.misaligned.append(corner)
        self.frame, self.origin, self.resolution = message.header.frame_id, np.array(origin), info.resolution
        values = np.asarray(message.data, np.int8).astype(np.uint8).reshape(size[1], size[0])
        self.costs = self._interpreted(values)

    def _interpreted(self, values: np.ndarray) -> np.ndarray:
        scaled = (values.astype(float) / self.lethal_threshold * LETHAL).astype(np.uint8)
        costs = np.full(values.shape, FREE, np.uint8) if self.trinary else scaled
        costs = np.where(values >= self.lethal_threshold, LETHAL, costs)
        costs = np.where(values == self.inscribed_value, INSCRIBED, costs)
        return np.where(values == self.unknown_value, UNKNOWN if self.track_unknown else FREE, costs)

    def window(self, centre: np.ndarray, size: float, resolution: float, global_frame: str) -> np.ndarray:
        """The rolling costmap around the robot, whose origin lies on its own grid."""
        assert self.frame == global_frame, "without a transform, the frames must be the same"
        count = round(size / resolution)
        low = np.floor((centre - size / 2) / resolution) * resolution
        x, y = (low[axis] + (np.arange(count) + 0.5) * resolution for axis in (0, 1))
        cell_x, cell_y = (
            np.floor((v - o) / self.resolution).astype(int) for v, o in zip((x, y), self.origin, strict=True)
        )
        rows, columns = self.costs.shape
        inside = ((cell_y >= 0) & (cell_y < rows))[:, None] & ((cell_x >= 0) & (cell_x < columns))[None]
        picked = self.costs[np.clip(cell_y, 0, rows - 1)[:, None], np.clip(cell_x, 0, columns - 1)[None]]
        return np.where(inside, picked, UNKNOWN)


def speed_limit(info, mask, place: np.ndarray) -> float:
    """Speed limit in per cent at a place by Nav2's speed filter; 0 is no limit."""
    assert info.type == 1
    origin = mask.info.origin.position
    cell = np.floor((place - [origin.x, origin.y]) / mask.info.resolution).astype(int)
    assert (cell >= 0).all() and cell[0] < mask.info.width and cell[1] < mask.info.height
    value = np.asarray(mask.data, np.int8).reshape(mask.info.height, mask.info.width)[cell[1], cell[0]]
    assert value != -1, "unknown cells are invalid for this filter"
    limit = float(value) * info.multiplier + info.base
    assert 0.0 <= limit <= 100.0
    return 0.0 if value == 0 else limit
