"""CostmapOutput: publishes each prediction's map for planners: occupancy, speed limits, and all layers."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from monoforce_ros.messages import encoding, message_class
from monoforce_ros.planning import AlignedGrid, Occupancy, occupancy, speed_mask
from monoforce_ros.prediction import Prediction

GRID_MAP, FILTER_INFO = "grid_map_msgs/msg/GridMap", "nav2_msgs/msg/CostmapFilterInfo"
_PERCENT = 1
"""Nav2's number of a speed filter in per cent of the largest speed."""
_MASK_INTERVAL = 1.0
"""Smallest time between speed masks [s]: Nav2's filter logs each one that it receives."""


class CostmapOutput:
    """Publishes what Nav2 and grid_map read, in the odometry frame.

    All topics are transient local, as Nav2's static layer and costmap filters expect. Without ``always`` a message is
    made only while somebody subscribes.

    Args:
        node: the node that publishes.
        settings: thresholds ``slope_limit`` [rad] and ``step_limit`` [m].
        always: make the occupancy grid also without subscribers.
    """

    def __init__(self, node: Node, settings: SimpleNamespace, *, always: bool):
        self._node, self._always = node, always
        self.apply(settings)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._occupancy = node.create_publisher(OccupancyGrid, "predicted/occupancy", latched)
        self._mask: Publisher | None = None
        self._mask_due = 0.0
        if filter_info := message_class(FILTER_INFO):
            self._mask = node.create_publisher(OccupancyGrid, "predicted/speed_mask", latched)
            self._info = node.create_publisher(filter_info, "predicted/speed_filter_info", latched)
            stamp = node.get_clock().now().nanoseconds
            mask_topic = node.resolve_topic_name("predicted/speed_mask")
            self._info.publish(encoding.costmap_filter_info(stamp, _PERCENT, mask_topic, 0.0, 1.0))
        self._grid_map: Publisher | None = None
        if grid_map := message_class(GRID_MAP):
            self._grid_map = node.create_publisher(grid_map, "predicted/grid_map", latched)

    def apply(self, settings: SimpleNamespace) -> None:
        """Apply thresholds that may have changed while the node runs."""
        self._slope_limit, self._step_limit = settings.slope_limit, settings.step_limit

    def publish(self, prediction: Prediction, frame_id: str) -> None:
        """Publish the map of a prediction; ``frame_id`` is that of the odometry."""
        if not self._node.context.ok():
            return
        with_map = self._grid_map is not None and self._grid_map.get_subscription_count() > 0
        with_mask = self._mask is not None and self._mask.get_subscription_count() > 0
        if not (self._always or with_map or with_mask or self._occupancy.get_subscription_count()):
            return
        pose, stamp = prediction.motion.odometry_from_terrain, prediction.stamp
        found = occupancy(prediction.terrain, pose, slope_limit=self._slope_limit, step_limit=self._step_limit)
        if not self._node.context.ok():
            return
        self._occupancy.publish(_grid_message(stamp, frame_id, found, found.data))
        now = time.monotonic()
        if with_mask and self._mask is not None and now >= self._mask_due:
            self._mask_due = now + _MASK_INTERVAL
            self._mask.publish(_grid_message(stamp, frame_id, found, speed_mask(found)))
        if with_map and self._grid_map is not None:
            self._grid_map.publish(grid_map_message(prediction, found, frame_id))


def _grid_message(stamp: int, frame_id: str, found: Occupancy, data: np.ndarray) -> bytes:
    return encoding.occupancy_grid(stamp, frame_id, found.resolution, (*found.origin, found.height), data)


def grid_map_message(prediction: Prediction, found: Occupancy, frame_id: str) -> bytes:
    """``grid_map_msgs/GridMap`` with every channel of the terrain and the cost.

    Heights [m] are z coordinates in the odometry frame; cells off the map, and costs of unknown cells, are NaN.
    """
    terrain, aligned = prediction.terrain, found.grid
    base = float(prediction.motion.odometry_from_terrain[2, 3])
    shape = terrain.height.shape[-2:]
    channels = {
        "height": terrain.height.numpy() + base,
        "geometric_height": terrain.geometric_height.numpy() + base,
        "stiffness": terrain.stiffness.numpy(),
        "damping": terrain.damping.numpy(),
        "friction": terrain.friction.numpy(),
        "observed": terrain.observed.numpy().astype(np.float32),
    }
    layers = {name: _layer(aligned, np.broadcast_to(values, shape)) for name, values in channels.items()}
    layers["cost"] = np.where(found.data < 0, np.nan, found.data).astype(np.float32)
    return encoding.grid_map(
        prediction.stamp, frame_id, found.resolution, found.origin, layers, basic_layers=("height",)
    )


def _layer(aligned: AlignedGrid, values: np.ndarray) -> np.ndarray:
    return aligned.resampled(values.astype(np.float32), np.nan)
