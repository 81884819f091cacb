"""Effects in a robot's file: what it says already is taken out once, added to, and compared with."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_clocks import turning
from test_effect_recovery import driven, rough_and_grassy
from test_region import _drive

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, CommandTrack
from monoforce_ros.discrepancy import commissioning
from monoforce_ros.discrepancy.clocks import compare_with_gyro, heading_disagreement
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate, beyond_file
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.export import effects_to_export
from monoforce_ros.discrepancy.hypothesis import corrected_evidence
from monoforce_ros.discrepancy.kept_effects import kept_effects
from monoforce_ros.discrepancy.sensor_findings import SensorFindings, changed_bias
from monoforce_ros.discrepancy.wording import finding
from monoforce_ros.effects import corrected_motion, recorded_motion
from monoforce_ros.robots import load_robot

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
LEVER, YAW = ("sensor_lever_arm", {"x": 0.5, "y": 0.0}), ("sensor_yaw_offset", {"angle": np.pi / 2})


def husky(*effects):
    return replace(load_robot("husky"), effects=effects)


def evidence_of(data, motion=None, gyro=None):
    motion = data.motion if motion is None else motion
    smoothed = SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),))
    return Evidence(smoothed, data.commands, data.terrain, data.odometry_from_terrain, gyro=gyro)


def turning_evidence(delay=0.0, bias=0.0):
    """A robot that turns both ways, with poses that are late and a gyro that is biased."""
    motion, gyro = turning(20.0)
    motion = replace(motion, stamps=motion.stamps + round(delay * 1e9))
    gyro = AngularVelocityTrack(gyro.stamps, gyro.rates + np.array([0.0, 0.0, bias]))
    commands = CommandTrack(np.arange(600, dtype=np.int64) * 10**8, np.full((600, 2), 0.5))
    return Evidence(SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), commands, gyro=gyro)


@pytest.mark.parametrize("effects", [(LEVER, YAW), (YAW, LEVER)])
def test_sensor_errors_are_taken_out_in_the_order_opposite_to_that_in_which_they_act(effects):
    motion = driven(husky()).motion
    robot = husky(*effects)
    wrong = recorded_motion(motion, robot)
    back = corrected_motion(wrong, robot.effects)
    np.testing.assert_allclose(back.positions, motion.positions, atol=1e-9)
    np.testing.assert_allclose(back.linear_velocities, motion.linear_velocities, atol=1e-9)
    # The lever arm is in the axes of the robot, however its sensor is turned.
    arm = Rotation.from_quat(motion.quaternions).inv().apply(wrong.positions - motion.positions)
    np.testing.assert_allclose(arm, np.tile([0.5, 0.0, 0.0], (len(arm), 1)), atol=1e-9)


@pytest.mark.parametrize("effect", [LEVER, ("pose_clock_offset", {"offset": 0.2})])
def test_commissioning_takes_out_what_the_file_says_of_sensors(effect):
    data, robot = driven(husky()), husky(effect)
    evidence = evidence_of(data, recorded_motion(data.motion, robot))
    estimates, nominal = commissioning.commission([evidence], robot)
    found = {estimate.name: estimate.parameters for estimate in estimates}
    # A healthy robot: its drives are neither late nor scrubbing, and nothing is left.
    assert found["command_delay"]["delay"].value < 0.05
    assert found["turning_scrub"]["track_width_factor"].value == pytest.approx(1.0, abs=0.05)
    assert np.abs(nominal.residual[-1]).max() < 0.02


@pytest.mark.parametrize("acting", [True, False])
def test_an_effect_of_the_file_that_stays_is_listed_and_an_outdated_one_is_named(acting):
    slow = ("drive_gain", {"gain": 0.8})
    lever = ("sensor_lever_arm", {"x": 0.5, "y": 0.0})
    robot = husky(slow, lever, ("friction_scale", {"factor": 0.9}))
    data = driven(husky(slow) if acting else husky())
    fitted = (estimate("friction_scale", factor=(1.0, 0.9, 1.1)),)
    evidence = evidence_of(data, recorded_motion(data.motion, husky(lever)))
    gain, arm = kept_effects([evidence], robot, fitted)
    assert gain.startswith("drive_gain: gain 0.8 stays as in the robot's file; it was not fitted")
    assert ("predicted no worse without it" in gain) == (not acting)
    # What sensors err by was taken out of the recordings.
    assert arm == "sensor_lever_arm: x 0.5 m, y 0 m stays as in the robot's file; it was not fitted"


def test_grass_that_one_recording_of_several_shows_is_not_held_against_the_robot():
    grass = ("vegetation_drag", {"coefficient": 1.5e4, "yield_speed": 0.5})
    terrain = rough_and_grassy()
    bare = replace(terrain, geometric_height=terrain.height)
    evidence = [evidence_of(driven(husky(grass), ground)) for ground in (bare, terrain)]
    prepared = [commissioning._prepare(entry, husky(), SAMPLES, 1.0) for entry in evidence]
    effects = (("drive_gain", {"gain": 1.0}), ("vegetation_drag", {"coefficient": 1e4, "yield_speed": 0.5}))
    fits = [commissioning._fitted(entry, effects, 6) for entry in prepared]
    merged = commissioning._merged([fit.effects for fit in fits], [False, True])
    for residuals in commissioning._held_out_residuals(prepared, fits, merged, [False, True]):
        assert np.sqrt((residuals[:, -1] ** 2).mean(axis=0)).max() < 0.02


def test_a_recording_with_a_gap_is_commissioned():
    data = _drive((), seconds=60.0)
    entry = commissioning._prepare(evidence_of(data), husky(), SAMPLES, 1.0)
    since = (entry.data.starts - data.starts[0]) * 1e-9
    # Two stretches whose segments take the same turn if those in the gap are counted.
    entry = entry[(since < 10.0) | (since > 46.0)]
    assert set(commissioning._segments(entry)) == {0, 3}
    effects = (("drive_gain", {"gain": 1.0}),)
    fits = [commissioning._fitted(entry, effects, 6)]
    (residuals,) = commissioning._held_out_residuals([entry], fits, fits[0].effects, [False])
    assert np.abs(residuals[:, -1]).max() < 0.05


@pytest.mark.parametrize(("true", "left"), [(0.3, 0.2), (0.0, -0.1), (0.1, None)])
def test_a_clock_that_moved_on_from_what_the_file_says_is_measured(true, left):
    robot = husky(("pose_clock_offset", {"offset": 0.1}))
    found = SensorFindings.of(corrected_evidence(turning_evidence(true), robot), robot, commissioned=True)
    if left is None:
        assert found.known == ()
        return
    ((name, values),) = found.known
    assert name == "pose_clock_offset" and values["offset"] == pytest.approx(left, abs=0.015)
    # What is written into the new file replaces what the old one says.
    estimate = EffectEstimate(name, {"offset": ParameterEstimate(values["offset"], -1.0, 1.0, "s")})
    (total,) = beyond_file([estimate], robot)
    assert total.parameters["offset"].value == pytest.approx(true, abs=0.015)


def test_a_gyro_bias_in_the_file_leaves_the_poses_alone_and_counts_once():
    robot, evidence = husky(("gyro_bias", {"bias": 0.02})), turning_evidence(bias=0.02)
    corrected = corrected_evidence(evidence, robot)
    before, after = (entry.smoothed.motion.angular_velocities for entry in (evidence, corrected))
    np.testing.assert_array_equal(after, before)
    found = compare_with_gyro(corrected.smoothed, corrected.gyro)
    assert found.bias == pytest.approx(0.02, abs=0.003)
    assert np.degrees(heading_disagreement(corrected.smoothed, corrected.gyro, found, 2.0)) < 0.5
    assert changed_bias(found, robot) is None and changed_bias(found, husky()) is not None
    # One that grew is said, as a whole.
    grown = compare_with_gyro(evidence.smoothed, turning_evidence(bias=0.06).gyro)
    changed = changed_bias(grown, robot)
    assert changed.parameters["bias"].value == pytest.approx(0.06, abs=0.003) and changed.in_file == {"bias": 0.02}


def estimate(name, **parameters):
    entries = {key: ParameterEstimate(*values, "-") for key, values in parameters.items()}
    return EffectEstimate(name, entries)


def test_what_was_found_is_judged_and_worded_against_the_file():
    robot = husky(("drive_gain", {"gain": 0.8}), ("friction_scale", {"factor": 0.5}))
    listed = [estimate("drive_gain", gain=(1.0, 0.98, 1.02)), estimate("friction_scale", factor=(0.8, 0.75, 0.85))]
    gain, friction = beyond_file(listed, robot)
    assert complaint(listed[0]) and not complaint(gain)
    assert complaint(beyond_file([estimate("drive_gain", gain=(0.8, 0.78, 0.82))], robot)[0])
    assert "60 % more" in finding(friction) and "slippery" not in finding(friction)
    assert finding(friction).endswith("The robot's file says factor 0.5.")
    exported = {effect.name: effect.parameters for effect in effects_to_export(robot, (gain,))}
    assert exported["drive_gain"]["gain"].value == 1.0
    assert "file" not in finding(listed[1])


def test_scrub_rotation_centre_and_payload_are_worded_against_the_file():
    robot = husky(
        ("turning_scrub", {"track_width_factor": 2.0}),
        ("rotation_centre", {"x": -0.1}),
        ("payload", {"mass": 10.0, "x": 0.1, "y": 0.0}),
    )

    def found(name, **values):
        return finding(beyond_file([estimate(name, **{k: (v, v, v) for k, v in values.items()})], robot)[0])

    # Less scrub than the file's: it turns more than the model does, though less than without any.
    assert found("turning_scrub", track_width_factor=1.6).startswith("The robot turns 25 % more than its model does")
    assert found("rotation_centre", x=-0.02).startswith("The robot turns about a point 0.08 m ahead of the one that")
    # 25 kg at 0.2 m are the file's 10 kg at 0.1 m and 15 kg at 0.267 m.
    assert found("payload", mass=25.0, x=0.2, y=0.0).startswith(
        "The robot carries 15 kg that its model does not have, 0.27 m ahead of"
    )
    assert found("payload", mass=2.0, x=0.1, y=0.0).startswith("The robot is 8 kg lighter than modelled, 0.10 m ahead")
    # As heavy, elsewhere: where the difference of next to nothing lies has no meaning.
    moved = found("payload", mass=10.2, x=-0.2, y=0.0)
    assert moved.startswith("The robot's load lies 0.3 m backward of where its model has it.")
    # Without a file they are as they were.
    assert "50 % less than" in finding(estimate("turning_scrub", track_width_factor=(2.0, 1.9, 2.1)))
