"""Description: links and joints of a URDF file as a tree, checked, with the pose of every link at the zero position."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.robots.urdf.errors import UrdfError
from monoforce_ros.robots.urdf.expansion import expand
from monoforce_ros.robots.urdf.shapes import MeshFiles, Shape, read_shape

MAXIMUM_URDF_BYTES = 10_000_000
MAXIMUM_LINKS = 5_000
_NUMBERS = frozenset((
    "xyz", "rpy", "value", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "radius", "length", "size", "scale", "lower",
    "upper", "effort", "velocity", "damping", "friction",
))  # fmt: skip
"""Attributes of links and joints that hold numbers."""
MOVING = ("continuous", "revolute", "prismatic")


@dataclass(frozen=True)
class Link:
    """A rigid link; lengths in metres, in the link's frame."""

    name: str
    mass: float
    """[kg]; 0 without an ``inertial`` element."""
    centre: np.ndarray
    """Centre of mass, ``[3]``."""
    inertia: np.ndarray
    """About the centre of mass in axes of the link's frame [kg m²], ``[3, 3]``."""
    shapes: tuple[Shape, ...]
    """Collision shapes."""
    visuals: tuple[Shape, ...]
    """Simple visual shapes, read only where there are no collision shapes."""
    without_meshes: bool = False
    """Whether collision meshes were left out."""


@dataclass(frozen=True)
class Joint:
    """A joint between two links."""

    name: str
    kind: str
    parent: str
    child: str
    pose: np.ndarray
    """Parent ← joint at the zero position, ``[4, 4]``."""
    axis: np.ndarray
    """Unit axis in the joint's frame, ``[3]``."""
    limits: tuple[float, float] | None
    """[rad] or [m]."""
    maximum_velocity: float | None
    """[rad/s] or [m/s]; None if not given or 0."""
    mimics: str | None
    """Name of the joint that it follows."""


@dataclass(frozen=True)
class Description:
    """A tree of links; poses are in the frame of ``root``."""

    path: Path
    name: str
    root: str
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    actuated: frozenset[str]
    """Joints named by a transmission or by ros2_control; empty if the file says nothing."""
    poses: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Pose of each link at the zero position, root ← link, ``[4, 4]``."""

    def children(self, link: str) -> list[Joint]:
        """Joints whose parent is ``link``."""
        return [joint for joint in self.joints.values() if joint.parent == link]

    def parent_joint(self, link: str) -> Joint | None:
        """The joint that carries ``link``; None for the root."""
        return next((joint for joint in self.joints.values() if joint.child == link), None)

    def subtree(self, link: str, through: Sequence[str] | None = None) -> Iterator[str]:
        """``link`` and all links that hang on it, through joints of the given kinds only (default: any)."""
        yield link
        for joint in self.children(link):
            if through is None or joint.kind in through:
                yield from self.subtree(joint.child, through)

    def turned(self, angles: Mapping[str, float]) -> Description:
        """The description with joints at other angles [rad] than 0, which become its zero position."""
        joints = dict(self.joints)
        for name, angle in angles.items():
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * joints[name].axis).as_matrix()
            joints[name] = replace(joints[name], pose=joints[name].pose @ turn)
        return replace(self, joints=joints, poses=_link_poses(self.root, joints))


def read_description(
    path: str | Path,
    *,
    packages: Mapping[str, Path] | None = None,
    ignore_meshes: bool = False,
    xacro_arguments: Sequence[str] = (),
) -> Description:
    """Read a URDF file, or a ``.xacro`` file where xacro is installed.

    Args:
        path: the file.
        packages: folders of packages that ``package://`` and ``$(find …)`` refer to, before those that are found.
        ignore_meshes: leave out all meshes.
        xacro_arguments: ``name:=value`` arguments for xacro.

    Raises:
        UrdfError: the file is missing, too large, unsafe or no URDF; its links form no tree; or a value is invalid.
    """
    path = Path(path).expanduser()
    text = _text(path, xacro_arguments, dict(packages or {}))
    parsed, tree = _parsed(text, path)
    if len(parsed.links) > MAXIMUM_LINKS:
        raise UrdfError(f"{path}: {len(parsed.links)} links, expected at most {MAXIMUM_LINKS}")
    files = MeshFiles(path, dict(packages or {}), ignore_meshes)
    links = {link.name: _link(link, path, files) for link in parsed.links}
    if len(links) < len(parsed.links):
        raise UrdfError(f"{path}: two links have the same name; names must be unique")
    joints = {joint.name: _joint(joint, path) for joint in parsed.joints}
    if len(joints) < len(parsed.joints):
        raise UrdfError(f"{path}: two joints have the same name; names must be unique")
    root = _root(links, joints, path)
    return Description(path, parsed.name or path.stem, root, links, joints, _actuated(tree), _link_poses(root, joints))


def _link_poses(root: str, joints: Mapping[str, Joint]) -> dict[str, np.ndarray]:
    poses = {root: np.eye(4)}
    pending = [root]
    while pending:
        parent = pending.pop()
        for joint in joints.values():
            if joint.parent == parent:
                poses[joint.child] = poses[parent] @ joint.pose
                pending.append(joint.child)
    return poses


def _text(path: Path, xacro_arguments: Sequence[str], packages: Mapping[str, Path]) -> str:
    if not path.is_file():
        raise UrdfError(f"{path}: the file does not exist")
    if path.stat().st_size > MAXIMUM_URDF_BYTES:
        raise UrdfError(f"{path}: {path.stat().st_size} bytes, expected at most {MAXIMUM_URDF_BYTES}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UrdfError(f"{path}: not UTF-8 text: {error}") from error
    _refuse_entities(text, path)
    if path.suffix == ".xacro" or "http://www.ros.org/wiki/xacro" in text or "http://wiki.ros.org/xacro" in text:
        text = expand(path, xacro_arguments, packages)
        if len(text) > MAXIMUM_URDF_BYTES:
            raise UrdfError(f"{path}: xacro made {len(text)} bytes, expected at most {MAXIMUM_URDF_BYTES}")
        _refuse_entities(text, path)
    return text


def _refuse_entities(text: str, path: Path) -> None:
    """Entities can expand to gigabytes or name other files, and no robot description needs them."""
    found = re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE)
    if found:
        raise UrdfError(f"{path}: contains {found.group(0)}: document types and entities are refused; remove them")


def _parsed(text: str, path: Path) -> tuple[Any, ElementTree.Element]:
    """The parsed robot, and the same file as a plain tree for elements that the parser skips."""
    try:
        from urdf_parser_py import urdf
        from urdf_parser_py.xml_reflection import core
    except ImportError as error:
        raise UrdfError("reading URDF needs urdf_parser_py: pip install urdf-parser-py") from error
    # Both libraries refuse a declaration of the encoding in text that is decoded already.
    text = re.sub(r"^\s*<\?xml[^>]*\?>", "", text, count=1)
    try:
        tree = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UrdfError(f"{path}: not XML: {error}") from error
    if tree.tag != "robot":
        raise UrdfError(f"{path}: the root element is {tree.tag!r}, expected 'robot'; is this a URDF file?")
    # Extensions of simulators and controllers are not part of URDF, and the parser may refuse them.
    for child in list(tree):
        if child.tag not in ("link", "joint"):
            tree.remove(child)
    kept = ElementTree.tostring(tree, encoding="unicode")
    before, core.on_error = core.on_error, lambda message: None
    try:
        return urdf.URDF.from_xml_string(kept), ElementTree.fromstring(text)
    except Exception as error:  # the parser raises plain exceptions for invalid elements
        raise UrdfError(f"{path}: not a valid URDF: {_no_number(tree) or error}") from error
    finally:
        core.on_error = before


def _no_number(tree: ElementTree.Element) -> str:
    """The first link or joint with a value that is no number, for which the parser names no place; empty if none."""
    for part in tree:
        for element in part.iter():
            for name in sorted(_NUMBERS.intersection(element.keys())):
                for word in element.get(name, "").split():
                    try:
                        float(word)
                    except ValueError:
                        where = f"{part.tag} {part.get('name')}: {element.tag}: {name}"
                        return f"{where}: got {element.get(name)!r}, expected numbers with a decimal point"
    return ""


def _actuated(tree: ElementTree.Element) -> frozenset[str]:
    found = set()
    for transmission in tree.iter("transmission"):
        found |= {joint.get("name", "") for joint in transmission.iter("joint")}
    for control in tree.iter("ros2_control"):
        for joint in control.iter("joint"):
            if joint.find("command_interface") is not None:
                found.add(joint.get("name", ""))
    return frozenset(found - {""})


def _root(links: Mapping[str, Link], joints: Mapping[str, Joint], path: Path) -> str:
    if not links:
        raise UrdfError(f"{path}: no links")
    parents: dict[str, str] = {}
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in links:
                raise UrdfError(f"{path}: joint {joint.name}: the link {link!r} does not exist")
        if joint.child in parents:
            raise UrdfError(
                f"{path}: link {joint.child} hangs on the joints {parents[joint.child]} and {joint.name}: a closed "
                "kinematic loop; remove one of them"
            )
        parents[joint.child] = joint.name
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        told = (
            f"the links {', '.join(sorted(roots)[:5])} have no parent" if roots else "every link has a parent: a loop"
        )
        raise UrdfError(f"{path}: {told}; expected one root link that carries all others")
    return roots[0]


def _pose(origin: Any, where: str) -> np.ndarray:
    pose = np.eye(4)
    if origin is not None:
        xyz = np.asarray([0, 0, 0] if origin.xyz is None else origin.xyz, float)
        rpy = np.asarray([0, 0, 0] if origin.rpy is None else origin.rpy, float)
        if xyz.shape != (3,) or rpy.shape != (3,) or not np.isfinite([*xyz, *rpy]).all():
            raise UrdfError(
                f"{where}: origin: got xyz {origin.xyz}, rpy {origin.rpy}, expected three finite numbers each"
            )
        pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return pose


def _link(link: Any, path: Path, files: MeshFiles) -> Link:
    where = f"{path}: link {link.name}"
    mass, centre, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    if link.inertial is not None:
        mass = float(link.inertial.mass or 0.0)
        if not math.isfinite(mass) or mass < 0:
            raise UrdfError(f"{where}: mass: got {mass:g}, expected a finite number of 0 kg or more")
        pose = _pose(link.inertial.origin, where)
        if link.inertial.inertia is not None:
            inertia = np.asarray(link.inertial.inertia.to_matrix(), float)
        if not np.isfinite(inertia).all():
            raise UrdfError(f"{where}: inertia: got {inertia.tolist()}, expected finite numbers")
        # Rounded files violate the triangle inequality by a little; negative moments are mistakes.
        if np.linalg.eigvalsh(inertia)[0] < -1e-6 * max(1.0, np.abs(inertia).max()):
            raise UrdfError(f"{where}: inertia: got a negative principal moment, expected none below 0 kg m²")
        centre, inertia = pose[:3, 3], pose[:3, :3] @ inertia @ pose[:3, :3].T
    shapes = tuple(_shapes(link.collisions, where, files))
    visuals: tuple[Shape, ...] = ()
    if not shapes:
        # Visual meshes are often missing or huge, and no robot depends on them.
        visuals = tuple(_shapes([v for v in link.visuals if not hasattr(v.geometry, "filename")], where, files))
    return Link(link.name, mass, centre, inertia, shapes, visuals, len(shapes) < len(link.collisions))


def _shapes(elements: Sequence[Any], where: str, files: MeshFiles) -> Iterator[Shape]:
    for element in elements:
        if element.geometry is not None:
            shape = read_shape(element.geometry, _pose(element.origin, where), where, files)
            if shape is not None:
                yield shape


def _joint(joint: Any, path: Path) -> Joint:
    where = f"{path}: joint {joint.name}"
    axis = np.asarray([1, 0, 0] if joint.axis is None else joint.axis, float)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) else math.nan
    if joint.type in MOVING and not (math.isfinite(length) and length > 1e-6):
        raise UrdfError(f"{where}: axis: got {joint.axis}, expected a direction")
    limits = velocity = None
    if joint.limit is not None:
        low, high = (float(v or 0.0) for v in (joint.limit.lower, joint.limit.upper))
        velocity = float(joint.limit.velocity or 0.0)
        if not math.isfinite(low) or not math.isfinite(high) or low > high or math.isnan(velocity):
            raise UrdfError(f"{where}: limit: got {low:g} to {high:g}, expected finite numbers, lower first")
        limits = (low, high) if high > low else None
    return Joint(
        name=joint.name,
        kind=joint.type,
        parent=joint.parent,
        child=joint.child,
        pose=_pose(joint.origin, where),
        axis=axis / length if length and math.isfinite(length) else np.array([1.0, 0.0, 0.0]),
        limits=limits,
        maximum_velocity=velocity if velocity and velocity > 0 else None,
        mimics=None if joint.mimic is None else str(joint.mimic.joint),
    )
