"""Terrain fit: the terrain that explains a driven trajectory, by gradient descent through the rollout (paper III-F)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from monoforce_ros.bags import JointRecord, Windows, cut_windows
from monoforce_ros.core import CommandTrack, MotionTrack, homogeneous, transform_points
from monoforce_ros.effects import controls
from monoforce_ros.physics import PhysicsOptions, State, rest_depth, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap, fill_holes
from monoforce_ros.training.trajectory_residual import robust_loss, trajectory_residual

_SAMPLE_TIME = 0.1
_HORIZONTAL_SCALE, _VERTICAL_SCALE, _TILT_SCALE, _HEADING_SCALE = 0.15, 0.01, np.radians(0.7), np.radians(4.0)
"""Scales of pose residuals [m, m, rad, rad]; wider horizontally and in heading because slip decides there."""
_MATERIAL_TRUST = 0.3
"""Weight of the square of local changes in the logarithm of friction and of stiffness."""
_FACTORS = {"friction": (0.1, 3.0), "stiffness": (0.01, 10.0)}
"""Range of fitted material relative to the initial one."""
_BLEND = 0.6
"""Distance from the wheel tracks beyond which the visible terrain replaces the traced one [m]."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the terrain fit."""

    chunk: float = 1.0
    """Length of the chunks that are rolled out from measured states [s]."""
    iterations: int = 60
    """Steps of the descent."""
    step: float = 0.004
    """Initial step in height [m]; it decays to a tenth."""
    margin: float = 2.0
    """Margin of the map around the trajectory [m]."""
    resolution: float = 0.1
    """Of the map [m]."""
    smoothness: float = 0.3
    """Weight of the squared curvature of the height change."""
    trust: float = 0.3
    """Weight of the squared height change: trust in the traced surface, since motion also depends on effects other than
    the terrain's shape, such as slip."""
    heights: bool = True
    """Whether to fit heights; otherwise they stay as the wheels traced them."""
    friction: bool = False
    """Whether to fit friction too, with the heading, which shows slip."""
    stiffness: bool = False
    """Whether to fit the stiffness of the ground too."""
    friction_step: float = 0.03
    """Initial step in the logarithm of friction and of stiffness."""

    def __post_init__(self):
        for name, low, high in (
            ("chunk", 0.2, 5.0),
            ("iterations", 0, 10_000),
            ("step", 1e-5, 0.1),
            ("margin", 0.5, 20.0),
            ("resolution", 0.02, 0.5),
            ("smoothness", 0.0, 1e6),
            ("trust", 0.0, 1e6),
            ("friction_step", 1e-4, 1.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"fit setting {name}: got {getattr(self, name)}, expected {low:g} to {high:g}")


@dataclass(frozen=True)
class TerrainFit:
    """Fitted terrain and its error in predicting the motion."""

    terrain: TerrainMap
    """``height`` is H_t*, ``geometric_height`` is H_g* (H_t* without a visible terrain); material as fitted."""
    contact_mask: np.ndarray
    """Cells that wheels or tracks touched, ``[rows, columns]`` bool: where H_t* is known."""
    odometry_from_terrain: np.ndarray
    """Pose ``[4, 4]`` of the map."""
    losses: np.ndarray
    """Loss of each step of the descent."""
    times: np.ndarray
    """Times of the poses within a chunk ``[K]`` [s]."""
    measured: np.ndarray
    """Positions in the map's frame ``[chunks, K, 3]`` [m]."""
    predicted: np.ndarray
    """Positions predicted on the fitted terrain ``[chunks, K, 3]`` [m]."""
    before: np.ndarray
    """Height error at the end of each chunk on the visible terrain ``[chunks]`` [m]."""
    after: np.ndarray
    """Height error at the end of each chunk on the fitted terrain ``[chunks]`` [m]."""


def trajectory_frame(motion: MotionTrack, start: int) -> np.ndarray:
    """Pose ``[4, 4]`` odometry ← map: at the robot's position at ``start`` [ns], x along its heading, z up."""
    return motion.at(start).odometry_from_terrain


def trajectory_grid(motion: MotionTrack, start: int, length: float, settings: FitSettings) -> Grid:
    """Grid in the trajectory's frame that covers the trajectory and a margin."""
    local = _positions(motion, start, length)[:, :2]
    low = np.floor((local.min(axis=0) - settings.margin) / settings.resolution)
    high = np.ceil((local.max(axis=0) + settings.margin) / settings.resolution)
    columns, rows = (high - low + 1).astype(int)
    origin = low * settings.resolution
    return Grid(int(rows), int(columns), settings.resolution, (float(origin[0]), float(origin[1])))


def fit_terrain(
    motion: MotionTrack,
    commands: CommandTrack,
    robot: RobotModel,
    *,
    start: int,
    length: float = 10.0,
    visible: TerrainMap | None = None,
    material: TerrainDefaults = TerrainDefaults(),  # noqa: B008  (frozen)
    settings: FitSettings = FitSettings(),
    backend: str = "auto",
    progress: Callable[[], None] = lambda: None,
    joints: JointRecord | None = None,
) -> TerrainFit:
    """Fit heights, and optionally friction and stiffness, to a driven trajectory.

    The map is initialised with the surface traced by the undersides of the wheels, blended into the visible terrain
    elsewhere. Chunks of the trajectory are rolled out in one batch from measured states, and gradient descent reduces
    their distance to the measured poses. The height change is smooth and limited to the surroundings of the tracks.

    Args:
        motion: measured, preferably smoothed (:func:`monoforce_ros.bags.smooth`).
        commands: recorded.
        robot: that was driven.
        start: start of the trajectory [ns].
        length: length of the trajectory [s].
        visible: visible terrain on :func:`trajectory_grid`; without it the map depends on the wheel tracks alone.
        material: stiffness, damping and initial friction of the ground.
        settings: settings of the fit.
        backend: backend of the rollout.
        progress: called after each step of the descent.
        joints: recorded joints of the robot, if there are any.

    Raises:
        ValueError: there is no odometry for a single chunk.
    """
    grid = trajectory_grid(motion, start, length, settings) if visible is None else visible.grid
    pose = trajectory_frame(motion, start)
    local = _within(motion, start, length)
    windows = cut_windows(
        local, commands, length=settings.chunk, stride=settings.chunk, sample_time=_SAMPLE_TIME, maximum_gap=0.5,
        joints=joints,
    )  # fmt: skip
    traced, contact_mask = traced_heights(local, robot, pose, grid, material.stiffness)
    initial = _initial_heights(traced, contact_mask, visible)
    geometric = initial if visible is None else visible.geometric_height.numpy()
    chunks = _Chunks(windows, robot, pose)
    terrain = TerrainMap.from_height(
        torch.from_numpy(initial.astype(np.float32)),
        grid,
        geometric_height=torch.from_numpy(np.asarray(geometric, np.float32)),
        observed=torch.from_numpy(contact_mask),
        material=material,
    )
    if visible is not None:
        terrain = replace(terrain, observed=terrain.observed | visible.observed)
    before = chunks.roll_out(visible if visible is not None else terrain, backend)
    terrain, losses = _descend(terrain, chunks, contact_mask, settings, backend, progress)
    after = chunks.roll_out(terrain, backend)
    measured = chunks.positions.numpy()
    return TerrainFit(
        terrain=terrain,
        contact_mask=contact_mask,
        odometry_from_terrain=pose,
        losses=np.array(losses),
        times=windows.times,
        measured=measured,
        predicted=after[0].numpy(),
        before=np.abs(before[0].numpy()[:, -1, 2] - measured[:, -1, 2]),
        after=np.abs(after[0].numpy()[:, -1, 2] - measured[:, -1, 2]),
    )


class _Chunks:
    """Chunks of a trajectory in the map's frame, ready to be rolled out."""

    def __init__(self, windows: Windows, robot: RobotModel, pose: np.ndarray):
        turn = pose[:3, :3].T

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)

        self.robot = robot
        self.options = PhysicsOptions()
        self.positions = tensor((windows.positions - pose[:3, 3]) @ turn.T)
        self.rotations = tensor(turn @ windows.rotations)
        self.index = torch.from_numpy(np.rint(windows.times / self.options.time_step).astype(np.int64))
        rotation = (turn @ windows.rotations)[:, 0]
        self.state = State(
            position=self.positions[:, 0].clone(),
            rotation=self.rotations[:, 0].clone(),
            velocity=tensor((rotation @ windows.velocities[:, 0, :, None])[..., 0]),
            angular_velocity=tensor((rotation @ windows.angular_velocities[:, 0, :, None])[..., 0]),
        )
        with torch.no_grad():
            self.controls = controls(
                robot, tensor(windows.twists), self.options.time_step, history=windows.history,
                joint_start=None if windows.joint_start is None else tensor(windows.joint_start),
                flippers=None if windows.flippers is None else tensor(windows.flippers),
            )  # fmt: skip

    def roll_out(self, terrain: TerrainMap, backend: str) -> tuple[Tensor, Tensor]:
        """Positions ``[chunks, K, 3]`` [m] and rotations ``[chunks, K, 3, 3]`` at the sampled times."""
        result = rollout(
            terrain, self.robot, self.controls, self.state, options=self.options, with_forces=False, backend=backend
        )
        return result.position[:, self.index], result.rotation[:, self.index]

    def loss(self, terrain: TerrainMap, backend: str, *, with_heading: bool) -> Tensor:
        """Huber loss of scaled residuals between predicted and measured poses; robust to slip."""
        positions, rotations = self.roll_out(terrain, backend)
        translation, rotation = trajectory_residual(
            positions[:, 1:], rotations[:, 1:], self.positions[:, 1:], self.rotations[:, 1:]
        )
        parts = [
            translation[..., :2] / _HORIZONTAL_SCALE,
            translation[..., 2:] / _VERTICAL_SCALE,
            rotation[..., :2] / _TILT_SCALE,
        ]
        if with_heading:
            # It hardly depends on heights.
            parts.append(rotation[..., 2:] / _HEADING_SCALE)
        scaled = torch.cat(parts, dim=-1)
        per_sample = robust_loss(scaled, 3.0)
        finite = torch.isfinite(per_sample)
        return torch.where(finite, per_sample, 0.0).sum() / finite.sum().clamp_min(1)


def _descend(
    terrain: TerrainMap,
    chunks: _Chunks,
    contact_mask: np.ndarray,
    settings: FitSettings,
    backend: str,
    progress: Callable[[], None],
) -> tuple[TerrainMap, list[float]]:
    near = torch.from_numpy((distance_transform_edt(~contact_mask) * settings.resolution < _BLEND).astype(np.float32))
    change = torch.zeros_like(terrain.height, requires_grad=True)
    groups = [{"params": [change], "lr": settings.step}] if settings.heights else []
    # Material has a global factor, and local changes where the motion requires them.
    fitted = [name for name in ("friction", "stiffness") if getattr(settings, name)]
    logarithms = {name: torch.zeros((), requires_grad=True) for name in fitted}
    locals_ = {name: torch.zeros_like(terrain.height, requires_grad=True) for name in fitted}
    if fitted:
        groups.append({"params": [*logarithms.values(), *locals_.values()], "lr": settings.friction_step})
    if not groups or not settings.iterations:
        return terrain, []
    optimiser = torch.optim.Adam(groups, betas=(0.8, 0.98))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(1, settings.iterations), 0.1 * settings.step)
    kernel, wide = _kernel(1.2), _kernel(4.0)
    resting = rest_depth(chunks.robot, float(terrain.stiffness.mean()))

    def current() -> tuple[TerrainMap, Tensor]:
        """The map, and what was added to its heights."""
        added = near * _blurred(change, kernel)
        height = terrain.height + added
        material = {
            name: getattr(terrain, name)
            * torch.exp(logarithms[name] + near * _blurred(locals_[name], wide)).clamp(*_FACTORS[name])
            for name in fitted
        }
        if settings.stiffness:
            # Where the wheels were is what was traced: on softer ground they stand deeper below its surface.
            height = height + resting * (terrain.stiffness / material["stiffness"] - 1.0)
        return replace(terrain, height=height, **material), added

    losses: list[float] = []
    best, least = terrain, np.inf
    for _ in range(settings.iterations):
        optimiser.zero_grad()
        candidate, added = current()
        data = chunks.loss(candidate, backend, with_heading=settings.friction)
        curvature = functional.conv2d(added[None, None] / _VERTICAL_SCALE, _LAPLACE)[0, 0]
        prior = settings.smoothness * (curvature**2).sum() + settings.trust * ((added / _VERTICAL_SCALE) ** 2).sum()
        prior = prior + _MATERIAL_TRUST * sum((local**2).sum() for local in locals_.values())
        loss = data + prior / max(1.0, float(near.sum()))
        loss.backward()
        losses.append(float(loss.detach()))
        if losses[-1] < least:
            best, least = _detached(candidate), losses[-1]
        optimiser.step()
        schedule.step()
        progress()
    return _detached(best), losses


_LAPLACE = torch.tensor([[[[0.0, 0.25, 0.0], [0.25, -1.0, 0.25], [0.0, 0.25, 0.0]]]])


def _kernel(deviation: float) -> Tensor:
    reach = round(3 * deviation)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation) ** 2)
    return weights / weights.sum()


def _blurred(values: Tensor, kernel: Tensor) -> Tensor:
    """A map blurred by a Gaussian, so that gradients of single cells act on their neighbours too."""
    reach = len(kernel) // 2
    rows = functional.conv2d(values[None, None], kernel[None, None, None], padding=(0, reach))
    return functional.conv2d(rows, kernel[None, None, :, None], padding=(reach, 0))[0, 0]


def _detached(terrain: TerrainMap) -> TerrainMap:
    return replace(
        terrain, height=terrain.height.detach(), friction=terrain.friction.detach(),
        stiffness=terrain.stiffness.detach(),
    )  # fmt: skip


def _within(motion: MotionTrack, start: int, length: float) -> MotionTrack:
    keep = (motion.stamps >= start) & (motion.stamps <= start + round(length * 1e9))
    if keep.sum() < 2:
        raise ValueError(f"trajectory: got {int(keep.sum())} poses in {length:g} s from {start}, expected at least 2")
    return replace(
        motion,
        stamps=motion.stamps[keep],
        positions=motion.positions[keep],
        quaternions=motion.quaternions[keep],
        linear_velocities=motion.linear_velocities[keep],
        angular_velocities=motion.angular_velocities[keep],
    )


def _positions(motion: MotionTrack, start: int, length: float) -> np.ndarray:
    return transform_points(np.linalg.inv(trajectory_frame(motion, start)), _within(motion, start, length).positions)


def traced_heights(
    motion: MotionTrack, robot: RobotModel, pose: np.ndarray, grid: Grid, stiffness: float
) -> tuple[np.ndarray, np.ndarray]:
    """Heights traced by the undersides of wheels and tracks ``[rows, columns]`` [m], and the contact mask."""
    underside = robot.underside.double().numpy()
    inverse = np.linalg.inv(pose)
    rotations = Rotation.from_quat(motion.quaternions).as_matrix()
    underside_points = [
        transform_points(inverse @ homogeneous(rotation, position), underside)
        for rotation, position in zip(rotations, motion.positions, strict=True)
    ]
    points = np.concatenate(underside_points)
    rows, columns, inside = grid.cells(points[:, :2])
    flat, heights = (rows * grid.columns + columns)[inside], points[inside, 2]
    order = np.lexsort((heights, flat))
    flat, heights = flat[order], heights[order]
    starts = np.flatnonzero(np.r_[True, flat[1:] != flat[:-1]])
    counts = np.diff(np.r_[starts, len(flat)])
    traced = np.zeros((grid.rows, grid.columns))
    # A low quantile: a wheel may hang above a cell that another wheel touches.
    traced.ravel()[flat[starts]] = heights[starts + counts // 4] + rest_depth(robot, stiffness)
    contact_mask = np.zeros((grid.rows, grid.columns), bool)
    contact_mask.ravel()[flat[starts]] = True
    return traced, contact_mask


def _initial_heights(traced: np.ndarray, contact_mask: np.ndarray, visible: TerrainMap | None) -> np.ndarray:
    """The traced surface, and the visible terrain away from it."""
    if visible is None:
        return fill_holes(traced, contact_mask)
    distant = distance_transform_edt(~contact_mask) * visible.grid.resolution > _BLEND
    known = contact_mask | (distant & visible.observed.numpy())
    return fill_holes(np.where(contact_mask, traced, visible.geometric_height.numpy()), known)
