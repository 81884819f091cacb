"""Robot files: YAML → RobotModel, with validation of every key."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from monoforce_ros.core import share_directory
from monoforce_ros.robots.belt import belt_outline
from monoforce_ros.robots.checks import FieldChecks, RobotFileError
from monoforce_ros.robots.hull import box_samples, wheel_samples
from monoforce_ros.robots.joint_reader import JointReader, WheelEntry
from monoforce_ros.robots.robot_model import Flipper, RobotModel

MAXIMUM_FILE_BYTES = 1_000_000
DEFAULT_SPACING = 0.05
"""Largest distance between neighbouring samples along a belt [m]; across it, rows are at most twice as far apart."""

_VALUE_KEYS = {"value", "low", "high", "unit"}
_TOP_KEYS = {
    "name", "description", "base_frame", "mass", "centre_of_mass", "inertia", "inertia_box", "command", "friction",
    "wheels", "tracks", "flippers", "hull", "sensors", "effects", "commissioning", "drive", "steering", "casters",
    "suspension", "rockers", "motors",
}  # fmt: skip


def shipped_robots() -> list[str]:
    """Names of the robots in the package."""
    return sorted(path.stem for path in (share_directory() / "config" / "robots").glob("*.yaml"))


def robot_file(name_or_file: str | Path) -> Path:
    """The YAML file of a robot, given by name or path.

    Raises ``RobotFileError``, which lists the shipped robots, if it does not exist.
    """
    text = str(name_or_file)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text).expanduser()
        if not path.is_file():
            raise RobotFileError(f"robot file {path} does not exist; give a file or one of {shipped_robots()}")
        return path
    path = share_directory() / "config" / "robots" / f"{text}.yaml"
    if not path.is_file():
        raise RobotFileError(f"there is no robot named {text!r}; expected a file or one of {shipped_robots()}")
    return path


def load_robot(name_or_file: str | Path, *, spacing: float = DEFAULT_SPACING) -> RobotModel:
    """Read a robot by name (``husky``) or file.

    Args:
        name_or_file: a shipped robot's name or the path of a YAML file.
        spacing: distance between samples of belts [m]; results depend on it only by discretisation. The hull is
            sampled at least as finely as :mod:`monoforce_ros.robots.hull` says.

    Raises:
        RobotFileError: the file is missing or not YAML, or a field is unknown, missing or out of its range.
    """
    path = robot_file(name_or_file)
    if path.stat().st_size > MAXIMUM_FILE_BYTES:
        raise RobotFileError(f"{path}: {path.stat().st_size} bytes; a robot file has at most {MAXIMUM_FILE_BYTES}")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RobotFileError(f"{path}: not readable as YAML: {error}") from error
    return _Reader(path).robot(content, spacing)


def _driven_radius(wheels: Sequence[Mapping[str, Any]]) -> float | None:
    """Mean radius of the driven wheels [m], without those of casters; of all wheels where none is driven."""
    radii = [wheel["radius"] for wheel in wheels if wheel.get("drive") is not None] or [w["radius"] for w in wheels]
    return float(np.mean(radii)) if radii else None


class _Reader(FieldChecks):
    """Converts parsed YAML into a RobotModel; every error names the file and the field."""

    def robot(self, content: Any, spacing: float) -> RobotModel:
        top = self.mapping(content, "the file", _TOP_KEYS, ["name", "mass", "command"])
        mass = self.number(top["mass"], "mass", 0.1, 1e5, "kg")
        command = self.mapping(
            top["command"],
            "command",
            {"track_width", "maximum_speed", "maximum_yaw_rate", "maximum_lateral_speed"},
            ["track_width"],
        )
        track_width = self.number(command["track_width"], "command.track_width", 0.05, 10.0, "m")
        friction = self.mapping(top.get("friction", {}), "friction", {"longitudinal", "lateral"})
        centre_of_mass = self.vector(top.get("centre_of_mass", [0, 0, 0]), "centre_of_mass", 3, 5.0, "m")
        listed = self.items(top.get("wheels", []), "wheels")
        entries = [self.wheel(wheel, f"wheels[{index}]") for index, wheel in enumerate(listed)]
        moving = JointReader(self, top, entries, mass, centre_of_mass)
        samples = _Samples()
        for index, (wheel, entry) in enumerate(zip(listed, entries, strict=True)):
            self.sample_wheel(wheel, f"wheels[{index}]", entry, moving, samples, spacing)
        for index, track in enumerate(self.items(top.get("tracks", []), "tracks")):
            self.track(track, f"tracks[{index}]", samples, spacing)
        for index, flipper in enumerate(self.items(top.get("flippers", []), "flippers")):
            self.flipper(flipper, f"flippers[{index}]", moving, samples, spacing)
        if not samples.radii:
            raise self.fail("wheels, tracks, flippers", "none", "at least one driven wheel, track or flipper")
        for index, box in enumerate(self.items(top.get("hull", []), "hull")):
            self.box(box, f"hull[{index}]", samples, spacing)
        points, point_drives = np.concatenate(samples.points), np.concatenate(samples.point_drives)
        middles = [points[point_drives == index].mean(axis=0) for index in range(len(samples.drives))]
        # Wheels that are steered or roll freely are where they are; the base controller knows one track width.
        drive_offsets = [
            middle[1] if moving.steers or name in samples.free else np.sign(middle[1]) * track_width / 2
            for name, middle in zip(samples.drives, middles, strict=True)
        ]

        def tensor(values: Any) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32)

        return RobotModel(
            name=str(top["name"]),
            base_frame=str(top.get("base_frame", "base_link")),
            mass=tensor(mass),
            centre_of_mass=tensor(centre_of_mass),
            inertia=tensor(self.inertia(top, mass)),
            points=tensor(points),
            point_areas=tensor(np.concatenate(samples.areas)),
            point_tangents=tensor(np.concatenate(samples.tangents)),
            point_drives=torch.as_tensor(point_drives, dtype=torch.int64),
            point_outward=tensor(np.concatenate(samples.outward)),
            point_widths=tensor(np.concatenate(samples.widths)),
            point_curvatures=tensor(np.concatenate(samples.curvatures)),
            drive_names=tuple(samples.drives),
            drive_offsets=tensor(drive_offsets),
            friction_longitudinal=tensor(
                self.number(friction.get("longitudinal", 1.0), "friction.longitudinal", 0.0, 10.0, "-")
            ),
            friction_lateral=tensor(self.number(friction.get("lateral", 1.0), "friction.lateral", 0.0, 10.0, "-")),
            maximum_speed=self.number(
                command.get("maximum_speed", math.inf), "command.maximum_speed", 0.01, math.inf, "m/s"
            ),
            maximum_yaw_rate=self.number(
                command.get("maximum_yaw_rate", math.inf), "command.maximum_yaw_rate", 0.01, math.inf, "rad/s"
            ),
            wheel_radius=_driven_radius(top.get("wheels", [])),
            sensors=self.sensors(top.get("sensors", {})),
            effects=self.effects(top.get("effects", [])),
            effect_intervals=self.intervals(top.get("effects", [])),
            flippers=tuple(samples.flippers),
            flipper_angles=tensor(samples.angles),
            point_flippers=torch.as_tensor(np.concatenate(samples.point_flippers), dtype=torch.int64),
            joints=tuple(moving.joints),
            joint_angles=tensor([0.0] * (len(moving.joints) - len(samples.angles)) + samples.angles),
            point_joints=torch.as_tensor(np.concatenate(samples.point_joints), dtype=torch.int64),
            point_grip=tensor([0.0 if d >= 0 and samples.drives[d] in samples.free else 1.0 for d in point_drives])
            if samples.free
            else None,
            motors=moving.motors(samples.members, samples.radii, len(samples.drives)),
            steered=moving.steered_drive(middles, samples.drives, samples.members),
            maximum_lateral_speed=self.number(
                command.get("maximum_lateral_speed", math.inf), "command.maximum_lateral_speed", 0.01, math.inf, "m/s"
            ),
        )

    def effects(self, content: Any) -> tuple[tuple[str, dict[str, float]], ...]:
        """Names and parameter values; they are checked against the catalogue where they are used."""
        listed = []
        for index, entry in enumerate(self.items(content, "effects")):
            where = f"effects[{index}]"
            effect = self.mapping(entry, where, {"name", "parameters", "provenance"}, ["name", "parameters"])
            if not isinstance(effect["parameters"], Mapping):
                raise self.fail(f"{where}.parameters", effect["parameters"], "a mapping of parameter names")
            values = {}
            for key, value in effect["parameters"].items():
                place = f"{where}.parameters.{key}"
                if isinstance(value, Mapping):
                    value = self.mapping(value, place, _VALUE_KEYS, ["value"])["value"]
                values[str(key)] = self.number(value, place, -math.inf, math.inf, "")
            listed.append((str(effect["name"]), values))
        return tuple(listed)

    def intervals(self, content: Any) -> tuple[tuple[str, dict[str, tuple[float, float]]], ...]:
        """Confidence intervals of the parameters that have one; :meth:`effects` has checked the entries."""
        listed = []
        for index, effect in enumerate(self.items(content, "effects")):
            known = {}
            for key, value in effect["parameters"].items():
                if not isinstance(value, Mapping) or not {"low", "high"} <= set(value):
                    continue
                place = f"effects[{index}].parameters.{key}"
                low = self.number(value["low"], f"{place}.low", -math.inf, math.inf, "")
                high = self.number(value["high"], f"{place}.high", -math.inf, math.inf, "")
                if low > high:
                    raise self.fail(place, f"low {low:g} above high {high:g}", "low ≤ high")
                known[str(key)] = (low, high)
            if known:
                listed.append((str(effect["name"]), known))
        return tuple(listed)

    def inertia(self, top: Mapping[str, Any], mass: float) -> np.ndarray:
        if ("inertia" in top) == ("inertia_box" in top):
            raise self.fail("inertia", sorted(set(top) & {"inertia", "inertia_box"}), "either inertia or inertia_box")
        if "inertia_box" in top:
            x, y, z = self.vector(top["inertia_box"], "inertia_box", 3, 20.0, "m") ** 2
            matrix = np.diag([y + z, x + z, x + y]) * mass / 12.0
        else:
            xx, yy, zz, xy, xz, yz = self.vector(top["inertia"], "inertia", 6, 1e5, "kg m²")
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = np.linalg.eigvalsh(matrix)
        if moments[0] <= 0 or moments[0] + moments[1] < moments[2] * (1 - 1e-6):
            raise self.fail(
                "inertia", moments.round(4).tolist(), "positive principal moments, the largest at most the others' sum"
            )
        return matrix

    def wheel(self, content: Any, where: str) -> WheelEntry:
        keys = {"name", "drive", "centre", "radius", "width"}
        wheel = self.mapping(content, where, keys, sorted(keys))
        return WheelEntry(
            str(wheel["name"]),
            None if wheel.get("drive") is None else str(wheel["drive"]),
            self.vector(wheel["centre"], f"{where}.centre", 3, 20.0, "m"),
            self.number(wheel["radius"], f"{where}.radius", 0.01, 3.0, "m"),
        )

    def sample_wheel(
        self,
        content: Mapping[str, Any],
        where: str,
        wheel: WheelEntry,
        moving: JointReader,
        samples: _Samples,
        spacing: float,
    ) -> None:
        # A wheel of a steered robot turns at the speed of its own path, and so does one that rolls freely.
        own = wheel.name if moving.steers or wheel.drive is None else wheel.drive
        first = len(samples.points)
        self.belt({**content, "drive": own}, where, (0.0, wheel.radius, wheel.radius), samples, spacing)
        width = float(content["width"])
        points, areas, normals = wheel_samples(wheel.radius, width, spacing)
        samples.add(wheel.centre + points, areas, np.zeros_like(points), None, normals)
        samples.widths.append(np.full(len(points), min(wheel.radius, width)))
        samples.curvatures.append(np.zeros(len(points)))
        for part in range(first, len(samples.points)):
            samples.point_joints[part][:] = moving.carrier.get(wheel.name, -1)
        if wheel.drive is None:
            samples.free.add(own)
        else:
            samples.radii.setdefault(wheel.drive, wheel.radius)
            index = samples.drives.index(own)
            if index not in samples.members.setdefault(wheel.drive, []):
                samples.members[wheel.drive].append(index)

    def track(self, content: Any, where: str, samples: _Samples, spacing: float) -> None:
        keys = {"name", "drive", "centre", "length", "radius", "width"}
        track = self.mapping(content, where, keys, sorted(keys))
        radius = self.number(track["radius"], f"{where}.radius", 0.01, 3.0, "m")
        length = self.number(track["length"], f"{where}.length", 0.01, 20.0, "m")
        self.belt(track, where, (length, radius, radius), samples, spacing)
        samples.drives_with(str(track["drive"]), radius)

    def flipper(self, content: Any, where: str, moving: JointReader, samples: _Samples, spacing: float) -> None:
        keys = {"name", "drive", "end", "joint", "length", "root_radius", "tip_radius", "width", "mass", "angle"}
        servo = {"limits", "maximum_rate", "time_constant", "maximum_torque", "maximum_power"}
        entry = self.mapping(content, where, keys | servo, sorted(keys))
        if entry["end"] not in ("front", "rear"):
            raise self.fail(f"{where}.end", entry["end"], "front or rear")
        joint = self.vector(entry["joint"], f"{where}.joint", 3, 20.0, "m")
        length = self.number(entry["length"], f"{where}.length", 0.01, 5.0, "m")
        root, tip = (self.number(entry[k], f"{where}.{k}", 0.01, 2.0, "m") for k in ("root_radius", "tip_radius"))
        if abs(root - tip) >= length:
            raise self.fail(f"{where}.length", length, "more than the difference of the radii [m]")
        angle = self.number(entry["angle"], f"{where}.angle", -7.0, 7.0, "rad")
        flipper = Flipper(
            name=str(entry["name"]),
            joint=(float(joint[0]), float(joint[1]), float(joint[2])),
            end=entry["end"],
            mass=self.number(entry["mass"], f"{where}.mass", 0.0, 1e4, "kg"),
            centre=length / 2,
        )
        first = len(samples.points)
        level = {**entry, "centre": [length / 2, 0.0, 0.0]}
        self.belt(level, where, (length, root, tip), samples, spacing)
        turn = flipper.turned(torch.tensor(angle, dtype=torch.float64)).numpy()
        samples.points[first] = joint + samples.points[first] @ turn.T
        samples.tangents[first] = samples.tangents[first] @ turn.T
        samples.drives_with(str(entry["drive"]), root)
        samples.point_flippers[first][:] = len(samples.flippers)
        samples.point_joints[first][:] = len(moving.joints)
        moving.joints.append(moving.flipper(entry, where, joint, angle, length))
        samples.flippers.append(flipper)
        samples.angles.append(angle)

    def belt(
        self,
        content: Mapping[str, Any],
        where: str,
        shape: tuple[float, float, float],
        samples: _Samples,
        spacing: float,
    ) -> None:
        centre = self.vector(content["centre"], f"{where}.centre", 3, 20.0, "m")
        width = self.number(content["width"], f"{where}.width", 0.005, 3.0, "m")
        outline, directions, lengths, curvatures = belt_outline(*shape, spacing)
        rows = max(2, math.ceil(width / (2 * spacing)))
        across = (np.arange(rows) + 0.5) / rows * width - width / 2
        positions = np.concatenate(
            [centre + np.stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]], axis=1) for y in across]
        )
        tangents = np.stack([directions[:, 0], np.zeros(len(directions)), directions[:, 1]], axis=1)
        samples.add(positions, np.tile(lengths * width / rows, rows), np.tile(tangents, (rows, 1)), content["drive"])
        samples.widths.append(np.full(len(positions), width))
        samples.curvatures.append(np.tile(curvatures, rows))

    def box(self, content: Any, where: str, samples: _Samples, spacing: float) -> None:
        box = self.mapping(content, where, {"name", "centre", "size"}, ["centre", "size"])
        centre = self.vector(box["centre"], f"{where}.centre", 3, 20.0, "m")
        size = self.vector(box["size"], f"{where}.size", 3, 20.0, "m")
        if (size <= 0).any():
            raise self.fail(f"{where}.size", size.tolist(), "positive edge lengths [m]")
        points, areas, normals, shorter = box_samples(size, spacing)
        samples.add(centre + points, areas, np.zeros_like(points), None, normals)
        samples.widths.append(shorter)
        samples.curvatures.append(np.zeros(len(points)))

    def sensors(self, content: Any) -> dict[str, torch.Tensor]:
        if not isinstance(content, Mapping):
            raise self.fail("sensors", content, "a mapping of frame names")
        poses = {}
        for frame, entry in content.items():
            where = f"sensors.{frame}"
            pose = self.mapping(entry, where, {"translation", "rotation", "quaternion"}, ["translation"])
            if ("rotation" in pose) == ("quaternion" in pose):
                raise self.fail(where, sorted(pose), "either rotation (roll, pitch, yaw) or quaternion (x, y, z, w)")
            matrix = np.eye(4)
            if "rotation" in pose:
                matrix[:3, :3] = Rotation.from_euler(
                    "xyz", self.vector(pose["rotation"], f"{where}.rotation", 3, 7.0, "rad")
                ).as_matrix()
            else:
                quaternion = self.vector(pose["quaternion"], f"{where}.quaternion", 4, 1.01, "-")
                if abs(np.linalg.norm(quaternion) - 1.0) > 1e-2:
                    raise self.fail(f"{where}.quaternion", quaternion.tolist(), "a unit quaternion x, y, z, w")
                matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            matrix[:3, 3] = self.vector(pose["translation"], f"{where}.translation", 3, 20.0, "m")
            poses[str(frame)] = torch.as_tensor(matrix, dtype=torch.float32)
        return poses


class _Samples:
    """Body samples collected from the parts of a robot file."""

    def __init__(self):
        self.points: list[np.ndarray] = []
        self.areas: list[np.ndarray] = []
        self.tangents: list[np.ndarray] = []
        self.point_drives: list[np.ndarray] = []
        self.outward: list[np.ndarray] = []
        self.widths: list[np.ndarray] = []
        self.curvatures: list[np.ndarray] = []
        self.point_flippers: list[np.ndarray] = []
        self.point_joints: list[np.ndarray] = []
        self.radii: dict[str, float] = {}
        self.members: dict[str, list[int]] = {}
        self.free: set[str] = set()
        self.drives: list[str] = []
        self.flippers: list[Flipper] = []
        self.angles: list[float] = []

    def add(
        self,
        points: np.ndarray,
        areas: np.ndarray,
        tangents: np.ndarray,
        drive: str | None,
        outward: np.ndarray | None = None,
    ) -> None:
        if drive is not None and drive not in self.drives:
            self.drives.append(str(drive))
        self.points.append(points)
        self.areas.append(areas)
        self.tangents.append(tangents)
        self.outward.append(np.zeros_like(points) if outward is None else outward)
        self.point_flippers.append(np.full(len(points), -1))
        self.point_joints.append(np.full(len(points), -1))
        self.point_drives.append(np.full(len(points), -1 if drive is None else self.drives.index(str(drive))))

    def drives_with(self, drive: str, radius: float) -> None:
        """A track's or flipper's drive and the radius at which it turns the belt [m]."""
        self.radii.setdefault(drive, radius)
        self.members.setdefault(drive, [self.drives.index(drive)])
