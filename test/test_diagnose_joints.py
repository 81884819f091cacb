"""`diagnose` on robots that steer or move flippers: hidden faults of MuJoCo worlds are named and measured."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from test_steering import rover

from monoforce_ros.bags import ReadOptions, smooth
from monoforce_ros.discrepancy import DiagnosisSettings, Evidence, Verdict, commission
from monoforce_ros.discrepancy.comparable_windows import comparable_starts, windows_of
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


def evidence_of(folder, robot_path, seed, *hidden, **settings):
    robot = load_robot(robot_path)
    faults = tuple(parse_hidden(text) for text in hidden)
    summary = record(folder, RecordingSettings(
        seed=seed, duration=40.0, robot=str(robot_path), commands="steps", terrain=TerrainSettings(flat=True), camera=None,
        lidar=None, hidden=faults, **settings,
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
        starts, _ = comparable_starts(evidence, self.robot, settings)
        noisy = noisy_motions(evidence.smoothed, settings.seed)
        windows = windows_of(evidence, self.robot, starts, np.array(settings.samples), noisy)
        found = explain(evidence, self.robot, windows, self.nominal, settings, exchange=False)
        trial = found.decision.trial
        estimates = () if trial is None else found.search.estimates(found.search.refit(trial.effects))
        return found, {estimate.name: estimate.parameters for estimate in estimates}


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    return Healthy(tmp_path_factory.mktemp("car"), small_car())


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [
        ("steering_offset", "offset", 0.08),
        ("steering_gain", "gain", 0.7),
        ("steering_lag", "time_constant", 0.5),
        ("steering_deadband", "width", 0.08),
    ],
)
def test_faults_of_the_steering_are_named_and_measured(car, name, parameter, value):
    found, effects = car.explained(f"{name}:{value}", name=name)
    assert found.decision.verdict == Verdict.EFFECT_FOUND, found.decision
    assert list(effects) == [name]
    estimate = effects[name][parameter]
    assert estimate.low <= value <= estimate.high or estimate.value == pytest.approx(value, rel=0.2)


def test_nothing_is_found_on_a_healthy_car(car):
    found, effects = car.explained()
    assert found.decision.verdict == Verdict.NO_DISCREPANCY and not effects


def test_a_blocked_flipper_is_named(tmp_path):
    content = yaml.safe_load(robot_file("marv").read_text(encoding="utf-8"))
    marv = Healthy(tmp_path, content, flippers="steps")
    found, effects = marv.explained("blocked_flipper:front_left=1", name="blocked")
    assert found.decision.verdict == Verdict.EFFECT_FOUND, found.decision
    assert list(effects) == ["blocked_flipper"]
    shares = {key: parameter.value for key, parameter in effects["blocked_flipper"].items()}
    assert shares.pop("front_left") == pytest.approx(1.0, abs=0.2)
    assert max(shares.values()) < 0.2
