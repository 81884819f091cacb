"""The measured latency of the candidates."""

import math

import pytest

from monoforce_ros.nodes.latency import LARGEST, Latency


def measured(*seconds: float) -> float:
    latency = Latency()
    for value in seconds:
        latency.add(value)
    return latency.typical


def test_the_first_results_and_single_slow_ones_do_not_count():
    assert measured() == measured(3.0, 3.0) == 0.0
    assert measured(0.3, 5.0, 0.3) == pytest.approx(0.3)


def test_it_follows_a_computer_that_becomes_slower_and_faster():
    assert measured(*[0.1] * 20, *[0.5] * 6) == pytest.approx(0.5)
    assert measured(*[0.5] * 20, *[0.1] * 6) == pytest.approx(0.1)


def test_clocks_that_jump_are_left_out_and_it_has_a_bound():
    assert measured(0.2, -7.0, 0.2, math.nan, math.inf, 0.2) == pytest.approx(0.2)
    assert measured(*[30.0] * 5) == LARGEST
