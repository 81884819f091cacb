"""Supports: casters and balls that are fixed to the body, which roll in any direction on a real robot."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from monoforce_ros.robots.urdf.description import Joint
from monoforce_ros.robots.urdf.geometry import Frames, WheelShape
from monoforce_ros.robots.urdf.parts import WheelPart
from monoforce_ros.robots.urdf.shapes import Shape

_NAMED = re.compile(r"caster|castor|swivel|(?<![a-z])ball(?![a-z])", re.IGNORECASE)
_REACH = 0.01
"""A support ends within this height of the ground [m], or a tenth of the wheels' radius."""
_SMALLEST = 0.25
"""Smallest radius of a support in radii of the wheels: what counts is where it touches the ground."""
_SMALLEST_RADIUS = 0.01
"""What a robot file allows [m]."""
_TRAIL = 0.5
"""Trail of a support in its radii: it follows the motion as a ball does."""


def find_supports(
    frames: Frames, wheels: Sequence[WheelPart], hints: Mapping[str, str], taken: Collection[str]
) -> list[WheelPart]:
    """Parts of the body that reach the ground as casters do: named so, hinted so, or spheres.

    Args:
        frames: poses.
        wheels: the wheels that are known, which give the ground.
        hints: kinds by link or joint name; ``caster`` names a support.
        taken: links that belong to other parts.
    """
    if not wheels:
        return []
    ground = min(float(wheel.shape.centre[2]) - wheel.shape.radius for wheel in wheels)
    radius = max(wheel.shape.radius for wheel in wheels)
    reach = max(_REACH, 0.1 * radius)
    found = []
    for link in _body(frames, taken):
        shapes = list(frames.shapes([link]))
        joint = frames.description.parent_joint(link)
        hint = hints.get(link) or hints.get("" if joint is None else joint.name)
        if not shapes or (hint is not None and hint != "caster"):
            continue
        if joint is None:
            # Tutorial robots have the ball of their caster in the root link itself.
            joint = Joint(
                f"{link}_support", "fixed", link, link, np.eye(4), np.array([0.0, 0.0, 1.0]), None, None, None
            )
            shapes = [entry for entry in shapes if entry[1].kind == "sphere"]
            hint = None
        named = bool(_NAMED.search(link) or _NAMED.search(joint.name))
        groups = [shapes] if named or hint else [[entry] for entry in shapes if entry[1].kind == "sphere"]
        for number, group in enumerate(groups):
            points = frames.placed(group)
            if not hint and abs(float(points[:, 2].min()) - ground) > reach:
                continue
            shape = _shape(points, group, max(_SMALLEST * radius, _SMALLEST_RADIUS))
            one = len(groups) == 1
            name, swivel = link if one else f"{link}_{number}", joint
            if not one:
                # Names of joints are unique.
                swivel = replace(joint, name=f"{joint.name}_{number}")
            reason = "by hint" if hint else "by its name" if named else "a sphere that reaches the ground"
            pivot = shape.centre + np.array([_TRAIL * shape.radius, 0.0, 0.0])
            found.append(
                WheelPart(
                    name, swivel, shape, swivel=swivel, shapes=tuple(entry[1] for entry in group), pivot=pivot,
                    reason=f"fixed to the body, {reason}",
                )
            )  # fmt: skip
    return found


def _body(frames: Frames, taken: Collection[str]) -> list[str]:
    """Links that are fixed to the base, the base itself left out."""
    description = frames.description
    root = frames.base
    while (joint := description.parent_joint(root)) is not None and joint.kind == "fixed":
        root = joint.parent
    return [link for link in description.subtree(root, ("fixed",)) if link not in taken]


def _shape(points: np.ndarray, group: Sequence[tuple[str, Shape]], smallest: float) -> WheelShape:
    low, high = points.min(axis=0), points.max(axis=0)
    radius = max(float(high[2] - low[2]) / 2, smallest)
    centre = np.array([*(low + high)[:2] / 2, low[2] + radius])
    kinds = " and ".join(sorted({shape.kind for _, shape in group}))
    return WheelShape(centre, radius, max(float(high[1] - low[1]) / 2, 0.2 * radius), kinds)
