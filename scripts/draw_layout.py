"""Draws recorded outputs of the predictor in the colours of the RViz layout, for places without RViz.

scripts/run.sh python scripts/draw_layout.py BAG [--out docs/first_drive.png]

BAG is a recording of bag_recorder with /predicted/terrain, /predicted/path, /predicted/contact_forces and, optionally,
/predicted/candidates and /predicted/best_path. The prediction with the longest paths is drawn.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from visualization_msgs.msg import Marker

from monoforce_ros.bags import BagReader
from monoforce_ros.core import write_bytes
from monoforce_ros.messages import decoding, stamp_of
from monoforce_ros.reporting import figure_png

TOPICS = ("terrain", "path", "contact_forces", "candidates", "best_path")


def predictions(bag: Path) -> dict[int, dict[str, object]]:
    """Messages by stamp and by the last part of their topic."""
    found: dict[int, dict[str, object]] = {}
    with BagReader(bag) as reader:
        for message in reader.messages([f"/predicted/{name}" for name in TOPICS]):
            decoded = message.decode()
            first = decoded.markers[0] if hasattr(decoded, "markers") else decoded
            found.setdefault(stamp_of(first), {})[message.topic.rsplit("/", 1)[-1]] = decoded
    return found


def path_positions(path) -> np.ndarray:
    """Positions ``[n, 3]`` of a nav_msgs/Path."""
    listed = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in path.poses]
    return np.array(listed).reshape(-1, 3)


def length(path) -> float:
    return float(np.linalg.norm(np.diff(path_positions(path), axis=0), axis=1).sum())


def lines(marker) -> Line3DCollection:
    """Line segments of a visualization_msgs/Marker in its colours."""
    points = np.array([(p.x, p.y, p.z) for p in marker.points])
    colours = [(c.r, c.g, c.b) for c in (marker.colors if len(marker.colors) else [marker.color] * len(points))]
    step = 2 if marker.type == Marker.LINE_LIST else 1
    starts = range(0, len(points) - 1, step)
    return Line3DCollection([points[n : n + 2] for n in starts], colors=[colours[n] for n in starts], linewidths=1.5)


def draw(messages: dict[str, object]) -> Figure:
    figure = Figure(figsize=(10, 5), dpi=110, facecolor="#1c2026")
    # A 3D view is drawn into a square and cut off at its edges: let the square be larger than the picture.
    axes = figure.add_axes((-0.1, -0.7, 1.2, 2.4), projection="3d", computed_zorder=False, facecolor="#1c2026")
    points = decoding.decode_cloud(messages["terrain"])
    path = path_positions(messages["path"])
    near = np.linalg.norm(points[:, :2] - path[0, :2], axis=1) < 5.0
    points = points[near]
    axes.scatter(*points.T, c=points[:, 2], cmap="turbo", s=30, marker="s", alpha=0.8, linewidths=0)
    for marker in getattr(messages.get("candidates"), "markers", []):
        if marker.type in (Marker.LINE_STRIP, Marker.LINE_LIST) and len(marker.points):
            axes.add_collection3d(lines(marker))
    if "best_path" in messages:
        axes.plot(*path_positions(messages["best_path"]).T, color="#28dc5a", linewidth=3)
    axes.plot(*path.T, color="#ffb020", linewidth=3)
    low, high = points.min(axis=0), points.max(axis=0)
    axes.set_box_aspect(high - low, zoom=0.95)
    axes.view_init(elev=38, azim=np.degrees(np.arctan2(*(path[-1] - path[0])[[1, 0]])) - 150)
    axes.set_axis_off()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent.parent / "docs" / "first_drive.png")
    options = parser.parse_args()
    found = [entry for entry in predictions(options.bag).values() if {"terrain", "path"} <= set(entry)]
    if not found:
        raise SystemExit(f"{options.bag} has no predictions: expected /predicted/terrain and /predicted/path")
    # Candidates follow the path in a thread of their own, and not each prediction gets them.
    complete = [entry for entry in found if "best_path" in entry] or found
    longest = max(
        complete, key=lambda entry: sum(length(entry[name]) for name in ("path", "best_path") if name in entry)
    )
    write_bytes(options.out, figure_png(draw(longest)))
    print(options.out)


if __name__ == "__main__":
    main()
