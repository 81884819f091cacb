"""Review: what is probably wrong with a robot file that was made from a description."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

SAME_AXLE = 0.05
"""Wheels within this distance along x share an axle [m]."""
_HANGING = 0.02
"""Height above the lowest wheel [m] from which a wheel is reported."""
_MIDDLE = 1e-3
"""Distance from the centre line [m] within which a part is on neither side."""


def side_of(y: float) -> str:
    """``left``, ``right`` or ``middle``, by the lateral position [m]."""
    return "left" if y > _MIDDLE else "right" if y < -_MIDDLE else "middle"


def review(content: Mapping[str, Any]) -> list[str]:
    """Warnings about the content of a robot file."""
    return [*_inertia(content), *_heights(content), *_wheels(content), *_balance(content)]


def _inertia(content: Mapping[str, Any]) -> Iterator[str]:
    """No mass within the robot's bounds is farther from its centre than half of their diagonal."""
    bounds = []
    for entry in content["hull"]:
        bounds.append((np.array(entry["centre"]), np.array(entry["size"]) / 2))
    for entry in content["wheels"]:
        bounds.append((np.array(entry["centre"]), np.array([entry["radius"], entry["width"] / 2, entry["radius"]])))
    for entry in content["tracks"]:
        half = [entry["length"] / 2 + entry["radius"], entry["width"] / 2, entry["radius"]]
        bounds.append((np.array(entry["centre"]), np.array(half)))
    for entry in content["flippers"]:
        reach = entry["length"] + max(entry["root_radius"], entry["tip_radius"])
        bounds.append((np.array(entry["joint"]), np.array([reach, entry["width"] / 2, reach])))
    if not bounds:
        return
    low = np.min([centre - half for centre, half in bounds], axis=0)
    high = np.max([centre + half for centre, half in bounds], axis=0)
    gyration = math.sqrt(max(content["inertia"][:3]) / content["mass"])
    largest = float(np.linalg.norm(high - low)) / 2
    if gyration > largest:
        yield (
            f"inertia: a radius of gyration of {gyration:.2f} m, expected at most half of the robot's diagonal, "
            f"{largest:.2f} m; are inertia elements of links placeholders?"
        )


def _heights(content: Mapping[str, Any]) -> Iterator[str]:
    lows = {w["name"]: w["centre"][2] - w["radius"] for w in content["wheels"]}
    ground = min([*lows.values(), *(t["centre"][2] - t["radius"] for t in content["tracks"])], default=None)
    if ground is None:
        return
    for name, low in lows.items():
        if low > ground + _HANGING:
            yield f"wheel {name} hangs {low - ground:.3f} m above the lowest one at the zero position"
    for box in content["hull"]:
        if box["centre"][2] - box["size"][2] / 2 < ground:
            yield f"hull {box['name']} reaches below the wheels; is it a shape of the body?"


def _wheels(content: Mapping[str, Any]) -> Iterator[str]:
    for wheel in content["wheels"]:
        side = side_of(wheel["centre"][1])
        other = {"left": "right", "right": "left"}.get(side)
        if other is not None and re.search(rf"(^|_){other}(_|$)", wheel["name"], re.IGNORECASE):
            yield (
                f"wheel {wheel['name']} lies on the {side}, y = {wheel['centre'][1]} m: are names or positions "
                "exchanged?"
            )
        if wheel["width"] > 2 * wheel["radius"]:
            yield f"wheel {wheel['name']} is wider than high: {wheel['width']} m"


def _balance(content: Mapping[str, Any]) -> Iterator[str]:
    along = [w["centre"][0] for w in content["wheels"]]
    for entry in content["tracks"]:
        along += [entry["centre"][0] - entry["length"] / 2, entry["centre"][0] + entry["length"] / 2]
    centre = content["centre_of_mass"][0]
    if not along:
        yield (
            "only flippers touch the ground; if the robot has tracks, name their links (--track LINK; a link with "
            "shapes on both sides gives two)"
        )
    elif content["flippers"]:
        return
    elif max(along) - min(along) < SAME_AXLE:
        yield (
            "all wheels stand on one axle, and nothing else is known to touch the ground: name the link of a caster "
            "or ball (--hint LINK=caster)"
        )
    elif not min(along) <= centre <= max(along):
        yield f"the centre of mass, x = {centre} m, lies outside the wheelbase: the robot tips over"
