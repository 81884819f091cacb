"""The verdict as a function of typed findings, without a recording."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from monoforce_ros.discrepancy.score_test import ScoreResult
from monoforce_ros.discrepancy.screening import Screened, admitted
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import FitTest, Trial, excess_share, expected_loss
from monoforce_ros.discrepancy.verdict import Findings, Verdict, decide

EFFECTS = (("drive_asymmetry", {"difference": 0.1}),)


def trial(loss: float, effects=()) -> Trial:
    return Trial(effects, (effects, effects), np.full(10, loss))


def found(after: float, *, before: float = 2.5, healthy: float = 0.5, p: float = 0.4, commissioned: bool = True):
    """Findings of one effect that reduces the mean loss to ``after``."""
    share = excess_share(before, after, healthy, Thresholds().drive_spread)
    fit = FitTest(p, "torque_z:vx", (), share if commissioned else 1.0)
    return Findings(trial(before), trial(after, EFFECTS), fit, healthy_loss=healthy, commissioned=commissioned)


@pytest.mark.parametrize("after", [0.4, 0.7, 1.3])
def test_an_effect_that_explains_most_of_the_excess_is_named(after):
    decision = decide(found(after))
    assert decision.verdict is Verdict.EFFECT_FOUND
    assert decision.trial is not None and decision.trial.names == ("drive_asymmetry",)


@pytest.mark.parametrize("after", [1.45, 1.6, 2.2])
def test_an_effect_that_explains_too_little_is_a_known_part_even_where_the_rest_is_within_chance(after):
    decision = decide(found(after))
    assert decision.verdict is Verdict.UNKNOWN_EFFECT
    assert decision.trial is None
    assert decision.parts is not None and decision.parts.names == ("drive_asymmetry",)
    first, second, *_ = decision.remarks
    share = (2.5 - after) / (2.5 - 0.5 * math.exp(Thresholds().drive_spread))
    assert first == f"drive_asymmetry explains only {100 * share:.0f} % of the excess loss"
    assert second == "more than 40 % of the excess is left"


def test_a_rest_that_does_not_look_healthy_is_unknown_however_small():
    decision = decide(found(0.7, p=0.001))
    assert decision.verdict is Verdict.UNKNOWN_EFFECT
    assert decision.remarks[1] == "what is left does not look like the healthy robot: torque_z:vx"


def test_the_share_is_not_asked_of_a_robot_whose_healthy_error_nobody_knows():
    assert decide(found(2.2, commissioned=False)).verdict is Verdict.EFFECT_FOUND


def test_a_formula_that_explains_most_of_what_a_name_leaves_contradicts_it():
    weak = found(2.2, commissioned=False)
    better = replace(weak, formula=trial(0.5, (("learned_term", {"torque_z:vx": 200.0}),)), formula_gain=(1.7, 0.9))
    decision = decide(better)
    assert decision.verdict is Verdict.UNKNOWN_EFFECT and decision.trial is better.formula
    assert "a formula explains most of what is left" in decision.remarks
    # By chance, or only a little: the name stays.
    assert decide(replace(better, formula_gain=(1.7, -0.1))).verdict is Verdict.EFFECT_FOUND
    little = trial(1.5, (("learned_term", {"torque_z:vx": 200.0}),))
    assert decide(replace(better, formula=little, formula_gain=(0.7, 0.2))).verdict is Verdict.EFFECT_FOUND


def test_without_effects_nothing_is_missing():
    nominal = trial(0.9)
    findings = Findings(nominal, nominal, FitTest(0.5, ""), healthy_loss=0.5, commissioned=True)
    assert decide(findings).verdict is Verdict.NO_DISCREPANCY
    alarm = decide(replace(findings, fit=FitTest(0.01, "force_x:1")))
    assert alarm.verdict is Verdict.UNKNOWN_EFFECT and alarm.parts is None


def test_the_share_of_the_excess():
    assert excess_share(2.5, 1.5, 0.5) == 0.5
    assert excess_share(2.5, 0.1, 0.5) == 1.0
    # Nothing in excess: whatever an effect removes is all of it.
    assert excess_share(0.4, 0.3, 0.5) == 1.0
    # What one healthy drive has more than another is no excess.
    assert excess_share(2.5, 1.5, 0.5 / math.e, spread=1.0) == pytest.approx(0.5)
    assert excess_share(0.55, 0.52, 0.5, spread=0.175) == 1.0
    assert Thresholds().most_share == 0.5 < Thresholds().explained_share


def test_an_error_of_the_formula_excuses_no_more_than_the_loss_that_it_causes():
    small = np.full((4, 2, 3), 2.0)
    assert expected_loss(0.4, small, 0.15) == pytest.approx(0.4 + 0.5 * 0.3**2)
    # Of ten windows one is thrown fifty times a healthy error: its square would stand for a rest of 3.2.
    change = np.zeros((10, 2, 3))
    change[0] = 50.0
    assert expected_loss(0.4, change, 0.15) == pytest.approx(0.4 + 0.1 * (3.0 * 7.5 - 0.5 * 3.0**2))
    assert expected_loss(0.4, change, 0.15) < 0.4 + 0.5 * np.mean((0.15 * change) ** 2)


def test_once_something_is_missing_the_best_explanation_may_be_the_least_certain_one():
    def candidate(name, loss, p, adjusted):
        result = ScoreResult(name, np.ones(1), np.eye(1), 8.0, p, adjusted, 0.1)
        return Screened(((name, {}),), loss, result)

    # A drag that fast stretches alone show explains most, with a large p-value of its own.
    drag = candidate("viscous_drag", 0.3, 0.2, 0.9)
    friction = candidate("friction_scale", 0.4, 0.007, 0.09)
    delay = candidate("command_delay", 1.0, 0.001, 0.01)
    worse = candidate("drive_gain", 1.3, 0.001, 0.01)
    names = [entry.name for entry in admitted([drag, friction, delay, worse], 1.2, 0.025)]
    assert names == ["viscous_drag", "friction_scale", "command_delay"]
    # Without one that is significant among all candidates nothing is missing.
    assert admitted([drag, friction], 1.2, 0.025) == [] and admitted([worse], 1.2, 0.025) == []
    # Unless the residuals are too large for a healthy robot.
    assert admitted([drag, worse], 1.2, 0.025, incomplete=True) == [drag]
