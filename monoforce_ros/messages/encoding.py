"""Arrays → serialized ROS messages. Stamps are in nanoseconds, positions in the named frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.messages.cdr import CdrWriter

_UINT32, _FLOAT32 = 6, 7
_LINE_LIST, _SPHERE_LIST = 5, 7


def grid_cells(stamp: int, frame_id: str, resolution: float, points: np.ndarray) -> bytes:
    """``nav_msgs/GridCells`` of cell centres ``[n, 3]`` [m]."""
    writer = CdrWriter()
    writer.header(stamp, frame_id)
    writer.fields("ff", resolution, resolution)
    writer.sequence(np.asarray(points, "<f8"), 8)
    return writer.bytes()


def point_cloud(stamp: int, frame_id: str, channels: dict[str, np.ndarray]) -> bytes:
    """``sensor_msgs/PointCloud2`` with one field per channel, each ``[n]``, in the order given.

    Fields are uint32 where the channel is, float32 otherwise.
    """
    whole = {name for name, values in channels.items() if np.asarray(values).dtype == np.uint32}
    columns = np.stack(
        [
            np.asarray(values, "<u4").ravel() if name in whole else np.asarray(values, "<f4").ravel().view("<u4")
            for name, values in channels.items()
        ],
        axis=1,
    )
    dense = all(np.isfinite(values).all() for name, values in channels.items() if name not in whole)
    count, step = len(columns), 4 * columns.shape[1]
    writer = CdrWriter()
    writer.header(stamp, frame_id)
    writer.fields("III", 1, count, len(channels))
    for index, name in enumerate(channels):
        writer.string(name)
        writer.fields("IBI", 4 * index, _UINT32 if name in whole else _FLOAT32, 1)
    writer.fields("BII", 0, step, step * count)
    writer.sequence(columns.reshape(-1).view(np.uint8), 1)
    writer.fields("B", int(dense))
    return writer.bytes()


def path(frame_id: str, stamps: np.ndarray, positions: np.ndarray, quaternions: np.ndarray) -> bytes:
    """``nav_msgs/Path`` of poses ``[n, 3]`` [m] and ``[n, 4]`` (x, y, z, w) at ``stamps`` ``[n]`` [ns].

    The stamp of the path is that of its first pose.
    """
    writer = CdrWriter()
    writer.header(int(stamps[0]), frame_id)
    writer.fields("I", len(stamps))
    name = frame_id.encode() + b"\x00"
    # Poses end on a multiple of 8 bytes, so that all but the first have the same layout.
    for first, last in ((0, 1), (1, len(stamps))):
        if first == last:
            continue
        padding = -(writer.position + 12 + len(name)) % 8
        layout = np.dtype([
            ("sec", "<i4"), ("nanosec", "<u4"), ("length", "<u4"), ("name", f"V{len(name)}"),
            ("padding", f"V{padding}"), ("position", "<f8", (3,)), ("orientation", "<f8", (4,)),
        ])  # fmt: skip
        poses = np.zeros(last - first, layout)
        poses["sec"], poses["nanosec"] = np.divmod(stamps[first:last], 10**9)
        poses["length"], poses["name"] = len(name), np.void(name)
        poses["position"], poses["orientation"] = positions[first:last], quaternions[first:last]
        writer.block(poses.view(np.uint8), 1)
    return writer.bytes()


@dataclass(frozen=True)
class ListMarker:
    """A ``visualization_msgs/Marker`` with a list of lines (pairs of points) or spheres, each with a colour."""

    namespace: str
    kind: str
    """``lines`` or ``spheres``."""
    points: np.ndarray
    """``[n, 3]`` [m]; for lines, two per line."""
    colours: np.ndarray
    """Red, green, blue, alpha in 0..1, ``[n, 4]`` or ``[4]``."""
    size: float
    """Width of the lines or diameter of the spheres [m]."""
    identifier: int = 0


def marker_array(stamp: int, frame_id: str, markers: Sequence[ListMarker]) -> bytes:
    """``visualization_msgs/MarkerArray``; each marker replaces the previous one of its namespace and identifier."""
    writer = CdrWriter()
    writer.fields("I", len(markers))
    for marker in markers:
        lines = marker.kind == "lines"
        writer.header(stamp, frame_id)
        writer.string(marker.namespace)
        # An empty list would leave the previous marker on screen, so the marker is deleted instead.
        writer.fields("iii", marker.identifier, _LINE_LIST if lines else _SPHERE_LIST, 0 if len(marker.points) else 2)
        writer.fields("ddddddd", 0, 0, 0, 0, 0, 0, 1)
        writer.fields("ddd", marker.size, 0.0 if lines else marker.size, 0.0 if lines else marker.size)
        colours = np.asarray(marker.colours, "<f4")
        writer.fields("ffff", *(colours if colours.ndim == 1 else (1.0, 1.0, 1.0, 1.0)))
        writer.fields("iIB", 0, 0, 0)  # lifetime: until replaced; frame_locked: no
        writer.sequence(np.asarray(marker.points, "<f8"), 8)
        writer.sequence(colours if colours.ndim == 2 else np.zeros((0, 4), "<f4"), 4)
        writer.string("")  # texture_resource
        writer.header(0, "")  # texture: an empty CompressedImage
        writer.string("")
        writer.fields("I", 0)
        writer.fields("I", 0)  # uv_coordinates
        writer.string("")  # text
        writer.string("")  # mesh_resource
        writer.string("")  # mesh_file: filename
        writer.fields("I", 0)  # mesh_file: data
        writer.fields("B", 0)  # mesh_use_embedded_materials
    return writer.bytes()


def occupancy_grid(
    stamp: int, frame_id: str, resolution: float, origin: tuple[float, float, float], data: np.ndarray
) -> bytes:
    """``nav_msgs/OccupancyGrid`` of int8 costs ``[rows, columns]``; ``origin`` is the corner of its first cell [m]."""
    rows, columns = data.shape
    writer = CdrWriter()
    writer.header(stamp, frame_id)
    writer.fields("iI", stamp // 10**9, stamp % 10**9)
    writer.fields("fII", resolution, columns, rows)
    writer.fields("ddddddd", *origin, 0.0, 0.0, 0.0, 1.0)
    writer.sequence(np.asarray(data, np.int8).reshape(-1), 1)
    return writer.bytes()


def grid_map(
    stamp: int,
    frame_id: str,
    resolution: float,
    origin: tuple[float, float],
    layers: Mapping[str, np.ndarray],
    basic_layers: Sequence[str],
) -> bytes:
    """``grid_map_msgs/GridMap`` of layers ``[rows, columns]`` along the axes of the frame; NaN is unknown.

    grid_map's first cell has the largest x and y, its row index runs against x and its column index against y, and its
    arrays are column-major.

    Args:
        stamp: [ns].
        frame_id: frame of the map.
        resolution: edge of a cell [m].
        origin: x and y of the corner of cell (0, 0) of the layers [m].
        layers: values by name, all of one shape, indexed ``[row = y, column = x]``.
        basic_layers: layers without which a cell is unknown.
    """
    rows, columns = next(iter(layers.values())).shape
    writer = CdrWriter()
    writer.header(stamp, frame_id)
    length = columns * resolution, rows * resolution
    writer.fields("ddd", resolution, *length)
    writer.fields("ddddddd", origin[0] + 0.5 * length[0], origin[1] + 0.5 * length[1], 0.0, 0.0, 0.0, 0.0, 1.0)
    writer.strings(tuple(layers))
    writer.strings(tuple(basic_layers))
    writer.fields("I", len(layers))
    for values in layers.values():
        writer.fields("I", 2)
        # Columns of the message are rows of the layer, along y.
        for label, size, stride in (("column_index", rows, rows * columns), ("row_index", columns, columns)):
            writer.string(label)
            writer.fields("II", size, stride)
        writer.fields("I", 0)
        writer.sequence(np.asarray(values[::-1, ::-1], "<f4").reshape(-1), 4)
    writer.fields("HH", 0, 0)
    return writer.bytes()


def costmap_filter_info(stamp: int, kind: int, mask_topic: str, base: float, multiplier: float) -> bytes:
    """``nav2_msgs/CostmapFilterInfo``: a cell of the mask means ``data * multiplier + base``.

    Args:
        stamp: [ns].
        kind: 0 keepout, 1 speed limit in per cent, 2 speed limit in m/s, 3 binary.
        mask_topic: topic of the ``nav_msgs/OccupancyGrid``.
        base, multiplier: conversion of the mask's values.
    """
    writer = CdrWriter()
    writer.header(stamp, "")
    writer.fields("B", kind)
    writer.string(mask_topic)
    writer.fields("ff", base, multiplier)
    return writer.bytes()


def float_table(rows: str, columns: Sequence[str], values: np.ndarray) -> bytes:
    """``std_msgs/Float32MultiArray`` of values ``[n, columns]``; the layout names rows and columns."""
    count, width = values.shape
    writer = CdrWriter()
    writer.fields("I", 2)
    for label, size, stride in ((rows, count, count * width), (",".join(columns), width, width)):
        writer.string(label)
        writer.fields("II", size, stride)
    writer.fields("I", 0)
    writer.sequence(np.asarray(values, "<f4").reshape(-1), 4)
    return writer.bytes()
