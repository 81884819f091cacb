"""A load carried by the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch

from monoforce_ros.effects.effect import Effect, Parameter, Product, Values
from monoforce_ros.effects.sentences import in_directions
from monoforce_ros.effects.setup import Setup
from monoforce_ros.robots import RobotModel, add_point_mass

_MOST_MISSING = -0.5
"""Share of a robot's mass of which at most it may be lighter than its file says."""
_LITTLE = 0.1
"""Share of a load below which a difference of two loads says how heavy they are, and not where the difference lies."""


class Payload(Effect):
    """A load carried by the robot."""

    name = "payload"
    stage = "body"
    summary = "A point mass on the robot changes mass, centre of mass and inertia."
    formula = "M ← M + m, c and J by the parallel-axis theorem"
    source = "rigid-body mechanics"
    cause = "a load"
    remedy = "weigh the robot, and enter the load in its file"
    parameters = (
        Parameter("mass", "kg", 0.0, -1e4, 1e4, 10.0, "added mass", of_mass=True),
        Parameter("x", "m", 0.0, -1.0, 1.0, 0.2, "position forward of the base frame"),
        Parameter("y", "m", 0.0, -1.0, 1.0, 0.2, "position to the left"),
        Parameter("z", "m", 0.0, -0.5, 1.5, 0.2, "position above"),
    )
    identified = ("mass", "x", "y")
    refined = ("z",)
    # A heavy load near the middle and a light one far out move the centre of mass alike.
    products = (
        Product("moment_x", ("mass", "x"), "kg m", "moment forward of the base frame's origin"),
        Product("moment_y", ("mass", "y"), "kg m", "moment to the left of the base frame's origin"),
    )
    manoeuvre = "turns on the spot, and driving up and across a slope"
    separated_by: ClassVar = {
        "turning_scrub": "turns on the spot, and driving across a slope",
        "sensor_lever_arm": "hard starts and stops straight ahead",
        "friction_scale": "driving up and across a slope",
    }

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Loads of a sixth and of two fifths of the robot's mass at the front and the rear; a centred load changes the
        motion too little for an initial value."""
        length = float(robot.points[:, 0].max() - robot.points[:, 0].min())
        return [
            {"mass": share * float(robot.mass), "x": place * length, "y": 0.0}
            for share in (0.16, 0.4)
            for place in (-0.3, 0.3)
        ]

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        robot = setup.robot
        # What is missing on a robot is a part of it.
        added = torch.maximum(values["mass"], _MOST_MISSING * robot.mass)
        position = torch.stack(torch.broadcast_tensors(values["x"], values["y"], values["z"]), dim=-1).to(robot.mass)
        total, centre, inertia = add_point_mass(robot.mass, robot.centre_of_mass, robot.inertia, added, position)
        return replace(setup, robot=replace(robot, mass=total, centre_of_mass=centre, inertia=inertia))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        mass = values["mass"]
        if "moved_x" in values or "moved_y" in values:
            moved = in_directions(values.get("moved_x", 0.0), values.get("moved_y", 0.0), "m")
            return f"The robot's load lies {moved} of where its model has it."
        place = ""
        if "x" in values and "y" in values:
            x, y = values["x"], values["y"]
            ahead = f"{abs(x):.2f} m {'ahead of' if x > 0 else 'behind'} the base frame's origin"
            place = f", {ahead} and {abs(y):.2f} m to its {'left' if y > 0 else 'right'}"
        if "z" in values:
            place += f", {abs(values['z']):.2f} m {'above' if values['z'] > 0 else 'below'} it"
        if mass < 0:
            return f"The robot is {-mass:.0f} kg lighter than modelled{place}."
        return f"The robot carries {mass:.0f} kg that its model does not have{place}."

    def beyond(
        self, values: Mapping[str, float], in_file: Mapping[str, float], outside: frozenset[str]
    ) -> Mapping[str, float]:
        """The point mass that makes the file's load the one that was found; where it would weigh little, how far the
        load lies from the file's place (``moved_x`` and so on), if that is beyond its interval, or only how much
        heavier it is.

        Its moment is the difference of both loads' moments.
        """
        if "mass" not in values or not in_file.get("mass"):
            return values
        mass = values["mass"] - in_file["mass"]
        further = {"mass": mass}
        for key in ("x", "y", "z"):
            if key in values and abs(mass) > _LITTLE * max(abs(values["mass"]), abs(in_file["mass"])):
                further[key] = (values["mass"] * values[key] - in_file["mass"] * in_file.get(key, 0.0)) / mass
            elif key in values and outside & {"x", "y"}:
                further[f"moved_{key}"] = values[key] - in_file.get(key, 0.0)
        return further
