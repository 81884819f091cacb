"""CandidateOutput: rolls out and assesses candidate commands for each prediction, and publishes the results."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import JointState, PointCloud2
from std_msgs.msg import Float32MultiArray
from visualization_msgs.msg import MarkerArray

from monoforce_ros.core import CommandTrack
from monoforce_ros.messages import decoding, message_class
from monoforce_ros.nodes import candidate_messages as messages
from monoforce_ros.nodes.health import ERROR, OK, WARN, Health
from monoforce_ros.nodes.latency import Latency
from monoforce_ros.physics import Rollout
from monoforce_ros.planning import (
    TERMS,
    Assessment,
    CandidateSettings,
    CostWeights,
    Limits,
    Refinement,
    assess,
    fan_of_arcs,
    force_every,
    over_horizon,
    refine,
)
from monoforce_ros.prediction import Prediction, Predictor
from monoforce_ros.robots import RobotModel, load_robot

PART = "candidates"
TYPED_MESSAGE = "monoforce_msgs/msg/Candidates"
MAXIMUM_CANDIDATES = 512
_STANDING = 1e-3
"""Largest command of a robot that stands still [m/s, rad/s]."""


class CandidateOutput:
    """Compares candidate commands for each prediction: a fan of arcs, or those that a planner requests.

    Raises:
        ValueError: a setting is out of its range.
    """

    def __init__(self, node: Node, predictor: Predictor, settings: SimpleNamespace, health: Health):
        self._node, self._settings, self._health = node, settings, health
        # Coarser time steps and contact points than for the prediction itself, as there are many candidates.
        options = replace(predictor.options, time_step=settings.candidate_time_step)
        robot = load_robot(settings.robot, spacing=settings.candidate_spacing)
        self._predictor = Predictor(robot, predictor.source, horizon=settings.horizon, options=options)
        self._force_every = force_every(options.time_step)
        self._fan = np.zeros((0, 4, 2))
        if settings.candidates:
            fan = CandidateSettings(
                settings.candidates, tuple(settings.candidate_speeds), settings.candidate_yaw_rate,
                curvature=robot.maximum_curvature,
                lateral=min(robot.maximum_lateral_speed, max(settings.candidate_speeds)) if _crabs(robot) else 0.0,
            )  # fmt: skip
            self._fan = fan_of_arcs(fan)
        self._requested: tuple[float, np.ndarray] | None = None
        self._round_seconds = 0.0
        self.latency = Latency()
        """Of the published candidates, against the odometry."""
        self.apply(settings)
        self._statistics: dict[str, str] = {}
        self._publishers = {
            "candidates": node.create_publisher(MarkerArray, "predicted/candidates", 1),
            "candidate_costs": node.create_publisher(PointCloud2, "predicted/candidate_costs", 1),
            "best_path": node.create_publisher(Path, "predicted/best_path", 1),
        }
        if robot.flippers:
            self._publishers["flipper_angles"] = node.create_publisher(JointState, "predicted/flipper_angles", 1)
        # If the message package is built, planners get everything in one typed message.
        if typed := message_class(TYPED_MESSAGE):
            self._publishers["candidate_rollouts"] = node.create_publisher(typed, "predicted/candidate_rollouts", 1)
        self._subscription = None
        if settings.candidate_topic:
            self._subscription = node.create_subscription(
                Float32MultiArray, settings.candidate_topic, self._on_sequences, 1
            )

    def apply(self, settings: SimpleNamespace) -> None:
        """Apply weights, limits and thresholds that may have changed while the node runs.

        Raises:
            ValueError: one is out of its range.
        """
        weights = CostWeights(**{name: getattr(settings, f"weight_{name}") for name in TERMS})
        limits = Limits(**{name: getattr(settings, f"limit_{name}") for name in TERMS})
        self._weights, self._limits, self._settings = weights, limits, settings

    def _on_sequences(self, message: Float32MultiArray) -> None:
        try:
            self._requested = time.monotonic(), decoding.decode_command_sequences(message, MAXIMUM_CANDIDATES)
        except decoding.MessageError as error:
            self._health.report(PART, ERROR, f"{self._settings.candidate_topic}: {error}", reason="unusable")

    @property
    def statistics(self) -> dict[str, str]:
        """For the diagnostics."""
        return self._statistics

    def publish(self, prediction: Prediction, commands: CommandTrack, frame_id: str) -> None:
        """Roll out all candidates on the prediction's map, and publish their costs.

        Args:
            prediction: provides the map and the start state.
            commands: up to the prediction.
            frame_id: frame of the odometry.
        """
        sequences = self._sequences()
        if not len(sequences):
            return
        motion, settings = prediction.motion, self._settings
        # Candidates take effect after the delay; the last command holds until then.
        time_step = self._predictor.options.time_step
        seconds = max(settings.candidate_delay, min(self.latency.typical, 0.5 * settings.horizon))
        delay = min(round(seconds / time_step), self._predictor.steps - 1)
        start, steps = self._predictor.history + delay, self._predictor.steps - delay
        # Whoever drives goes on sending it: it does not expire while the candidates are computed.
        stamps = np.minimum(self._predictor.command_stamps(prediction.stamp)[:start], prediction.stamp)
        before = commands.sample(stamps, timeout=settings.command_timeout)
        # A planner's sequences have no lateral speed.
        width = max(0, before.shape[-1] - sequences.shape[-1])
        sequences = np.pad(sequences, ((0, 0), (0, 0), (0, width)))
        twists = over_horizon(sequences, before, steps)
        standing = self._standing(prediction, before)
        rollout, assessment = self._assess(prediction, twists, standing)
        angles = self._commanded_flippers(prediction)
        # Standing costs least and makes no progress: it is the best one only where nothing else is feasible.
        moving = torch.from_numpy(np.abs(sequences).max(axis=(1, 2)) > _STANDING)
        best = assessment.best_among(moving)
        # Speed and yaw rate are refined, of candidates that do not move sideways.
        if settings.refine_seconds and best is not None and not sequences[best][:, 2:].any():
            found = self._refined(prediction, before[:, :2], sequences[best][:, :2], standing)
            padded = np.pad(found.sequence[None], ((0, 0), (0, 0), (0, before.shape[-1] - 2)))
            refined = over_horizon(padded, before, steps)
            refined_rollout, refined_assessment = self._assess(prediction, refined, standing, found.flippers)
            twists = np.concatenate([twists, refined])
            rollout, assessment = rollout.joined(refined_rollout), assessment.joined(refined_assessment)
            best = assessment.best_among(torch.cat([moving, torch.ones(1, dtype=torch.bool)]))
            if found.flippers is not None and best == len(twists) - 1:
                angles = found.flippers
        best = assessment.best if best is None else best
        data: dict[str, object] = {
            "candidates": messages.candidate_markers(motion, rollout, assessment, best, frame_id),
            "candidate_costs": messages.candidate_costs(
                motion, rollout, twists[:, start], assessment, frame_id, delay * time_step
            ),
        }
        if best is not None:
            if angles is not None:
                data["flipper_angles"] = self._flipper_angles(prediction, angles, delay)
            data["best_path"] = messages.best_path(motion, rollout, best, frame_id, settings.path_time_step)
        if "candidate_rollouts" in self._publishers:
            data["candidate_rollouts"] = messages.candidate_rollouts(
                motion, rollout, self._predictor.robot, twists[:, self._predictor.history :, :2], assessment, best,
                frame_id, settings.path_time_step,
            )  # fmt: skip
        self._statistics["candidates start after [s]"] = f"{delay * time_step:.2f}"
        self._statistics["feasible candidates"] = f"{int(assessment.feasible.sum())} of {len(twists)}"
        if self._node.context.ok():
            for name, message in data.items():
                self._publishers[name].publish(message)

    def _sequences(self) -> np.ndarray:
        """Commands to compare ``[N, K, 2]``: the planner's while they are fresh, otherwise the fan."""
        settings = self._settings
        if not settings.candidate_topic:
            return self._fan
        problem = "no candidates received yet"
        if self._requested is not None:
            arrival, sequences = self._requested
            age = time.monotonic() - arrival
            if age <= settings.data_timeout:
                message = f"comparing the candidates on {settings.candidate_topic}"
                self._health.report(PART, OK, message, reason="planner")
                return sequences
            problem = f"no candidates for {age:.1f} s"
        fallback = f"using the fan of {len(self._fan)} arcs" if len(self._fan) else "comparing none"
        self._health.report(PART, WARN, f"{settings.candidate_topic}: {problem}; {fallback}", reason="silent")
        return self._fan

    def _commanded_flippers(self, prediction: Prediction) -> np.ndarray | None:
        """Angles that the flippers are commanded over the horizon ``[T, F]`` [rad]; None without flippers."""
        if prediction.joints is None:
            return None
        commanded_flippers = prediction.joints.flippers(1, self._predictor.steps, self._predictor.options.time_step)
        return None if commanded_flippers is None else commanded_flippers[0].double().numpy()

    def _flipper_angles(self, prediction: Prediction, angles: np.ndarray, delay: int) -> JointState:
        """The best candidate's flipper angles at its start, stamped with that time."""
        message = JointState()
        step_time = self._predictor.options.time_step
        stamp = prediction.stamp + round(delay * step_time * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        message.name = [flipper.name for flipper in self._predictor.robot.flippers]
        message.position = angles[delay].tolist()
        return message

    def _standing(self, prediction: Prediction, before: np.ndarray) -> Rollout | None:
        """The rollout without commands; None if the robot is commanded to move before the candidates start."""
        if np.abs(before[self._predictor.history :]).max(initial=0.0) > _STANDING:
            return None
        steps = self._predictor.history + self._predictor.steps
        return self._roll_out(prediction, np.zeros((1, steps, before.shape[-1])))

    def _roll_out(self, prediction: Prediction, twists: np.ndarray, flippers: np.ndarray | None = None) -> Rollout:
        motions = [prediction.motion] * len(twists)
        return self._predictor.roll_out(
            prediction.terrain, motions, twists, with_forces=False, with_contact=True, force_every=self._force_every,
            joints=prediction.joints, flippers=None if flippers is None else flippers[None],
        )  # fmt: skip

    def _assess(
        self,
        prediction: Prediction,
        twists: np.ndarray,
        standing: Rollout | None,
        flippers: np.ndarray | None = None,
    ) -> tuple[Rollout, Assessment]:
        rollout = self._roll_out(prediction, twists, flippers)
        # Costs are of the forward speed: moving sideways alone costs no slip.
        commanded = torch.from_numpy(twists[:, self._predictor.history :, :2]).float()
        found = assess(
            rollout, prediction.terrain, self._predictor.robot, commanded,
            weights=self._weights, limits=self._limits, standing=standing,
        )  # fmt: skip
        return rollout, found

    def _refined(
        self, prediction: Prediction, before: np.ndarray, best: np.ndarray, standing: Rollout | None
    ) -> Refinement:
        """The best candidate, refined."""
        budget = self._settings.refine_seconds
        found = refine(
            self._predictor, prediction, before, best, weights=self._weights, limits=self._limits,
            seconds=budget, round_seconds=self._round_seconds, standing=standing,
        )  # fmt: skip
        # A slow first round, in which kernels are loaded, must not disable refinement for good.
        self._round_seconds = found.round_seconds if found.rounds else 0.9 * self._round_seconds
        if found.rounds:
            self._statistics["refined cost"] = f"{found.cost_before:.3f} to {found.cost:.3f} in {found.rounds} rounds"
        else:
            self._statistics["refined cost"] = (
                f"not refined: a round takes {1e3 * self._round_seconds:.0f} ms, refine_seconds is {budget:g}"
            )
        return found


def _crabs(robot: RobotModel) -> bool:
    return robot.steered is not None and robot.steered.crabs
