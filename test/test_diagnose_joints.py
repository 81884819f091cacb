"""`diagnose` on robots with joints: hidden faults of a MuJoCo world are named and measured."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from test_steering import rover

from monoforce_ros.bags import ReadOptions, smooth
from monoforce_ros.discrepancy import DiagnosisSettings, Evidence, Verdict, commission, diagnose
from monoforce_ros.discrepancy.comparable_windows import comparable_windows, windows_of
from monoforce_ros.discrepancy.explanation import explain
from monoforce_ros.discrepancy.gap import noisy_motions
from monoforce_ros.robots import load_robot, robot_file
from monoforce_ros.synthetic.hidden import parse_hidden
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.terrain_shape import TerrainSettings

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(900)]


def small_car():
    """A car of 60 kg whose front wheels steer at a servo's pace."""
    content = rover("ackermann", limit=0.5)
    content["steering"] = [entry | {"maximum_rate": 3.0, "time_constant": 0.05} for entry in content["steering"][:2]]
    for wheel in content["wheels"]:
        wheel["drive"] = "rear" if wheel["centre"][0] < 0 else None
    return content


def evidence_of(folder, robot_path, seed, *hidden, seconds=40.0, **settings):
    robot = load_robot(robot_path)
    faults = tuple(parse_hidden(text) for text in hidden)
    summary = record(folder, RecordingSettings(
        seed=seed, duration=seconds, robot=str(robot_path), commands="steps", terrain=TerrainSettings(flat=True),
        camera=None, lidar=None, hidden=faults, **settings,
    ))  # fmt: skip
    assert summary.mishap is None
    recording = ReadOptions().open(folder, robot)
    motion = smooth(recording.motion)
    return Evidence(
        motion, recording.commands, gyro=recording.angular_velocity, wheels=recording.wheels, joints=recording.joints
    )


class Healthy:
    """A robot that was commissioned on a drive without a fault."""

    def __init__(self, folder, content, **settings):
        self.folder, self.settings = folder, settings
        self.path = folder / f"{content['name']}.yaml"
        self.path.write_text(yaml.safe_dump(content))
        evidence = evidence_of(folder / "healthy", self.path, 31, **settings)
        effects, self.nominal = commission([evidence], load_robot(self.path))
        fitted = tuple((e.name, {key: p.value for key, p in e.parameters.items()}) for e in effects)
        self.robot = replace(load_robot(self.path), effects=fitted)

    def explained(self, *hidden, name="faulty"):
        """What explains a drive with hidden faults, and the estimates of the effects."""
        settings = DiagnosisSettings(max_effects=1)
        evidence = evidence_of(self.folder / name, self.path, 32, *hidden, **self.settings)
        starts = comparable_windows(evidence, self.robot, settings).starts
        noisy = noisy_motions(evidence.smoothed, settings.seed)
        windows = windows_of(evidence, self.robot, starts, np.array(settings.samples), noisy)
        found = explain(evidence, self.robot, windows, self.nominal, settings, repeated=True)
        trial = found.decision.trial
        estimates = () if trial is None else found.search.estimates(found.search.refit(trial.effects))
        return found, {estimate.name: estimate.parameters for estimate in estimates}


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    return Healthy(tmp_path_factory.mktemp("car"), small_car())


@pytest.mark.parametrize(
    ("name", "parameter", "value"), [("steering_offset", "offset", 0.08), ("steering_deadband", "width", 0.08)]
)
def test_faults_of_the_steering_are_named_and_measured(car, name, parameter, value):
    found, effects = car.explained(f"{name}:{value}", name=name)
    assert found.decision.verdict == Verdict.EFFECT_FOUND, found.decision
    assert list(effects) == [name]
    # The servo gives way at the edge of the play, which looks like less play.
    assert effects[name][parameter].value == pytest.approx(value, rel=0.1 if name == "steering_offset" else 0.2)


def test_a_flipper_that_does_not_move_is_named_beside_a_path_that_hardly_changes(tmp_path):
    content = yaml.safe_load(robot_file("marv").read_text(encoding="utf-8"))
    path = tmp_path / "marv.yaml"
    path.write_text(yaml.safe_dump(content))
    hidden = "blocked_flipper:rear_left=1"
    evidence = evidence_of(tmp_path / "blocked", path, 32, hidden, seconds=24.0, flippers="steps")
    diagnosis = diagnose(evidence, load_robot(path), settings=DiagnosisSettings(max_effects=1))
    assert diagnosis.verdict == Verdict.EFFECT_FOUND, diagnosis.remarks
    found = {effect.name: effect.parameters for effect in diagnosis.effects}
    shares = {place: parameter.value for place, parameter in found["blocked_flipper"].items()}
    assert shares.pop("rear_left") == pytest.approx(1.0, abs=0.05)
    assert not any(shares.values())
    assert diagnosis.gap["flippers"].after < 0.3 * diagnosis.gap["flippers"].before
