"""The first screen of a diagnosis follows the verdict and what is explained on held-out data."""

import math
import re
from dataclasses import replace

import pytest

from monoforce_ros.discrepancy import Diagnosis, EffectEstimate, ParameterEstimate, Verdict
from monoforce_ros.discrepancy.bag_diagnosis import without_blame_for_ground
from monoforce_ros.discrepancy.comparison import GapRow
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.gap import Localisation, NoiseFloor
from monoforce_ros.discrepancy.ground import beyond_commissioning
from monoforce_ros.discrepancy.headline import Tone, explained, headline
from monoforce_ros.discrepancy.page import diagnosis_page
from monoforce_ros.discrepancy.partial_effects import effects_for_file, file_entry, with_advice
from monoforce_ros.discrepancy.preflight import advice
from monoforce_ros.discrepancy.report import report_content, summary_lines
from monoforce_ros.discrepancy.verdict import Losses
from monoforce_ros.discrepancy.wording import cause, finding, remedy
from monoforce_ros.effects import CATALOGUE, identifiable_effects, separating_manoeuvre, separating_sensor
from monoforce_ros.robots import load_robot, write_robot


def effect(name, *, indistinguishable=(), **parameters):
    """An estimate; each parameter is (value, low, high)."""
    units = {parameter.name: parameter.unit for parameter in CATALOGUE[name].parameters}
    entries = {key: ParameterEstimate(*values, units[key]) for key, values in parameters.items()}
    return EffectEstimate(name, entries, indistinguishable)


DELAY = effect("command_delay", delay=(0.3, 0.28, 0.32))


def row(before, after, unit="m", noise=0.01, horizon=2.0):
    change = 0.0 if after is None else before - after
    bounds = (None, None) if after is None else (change - 0.001, change + 0.001)
    return GapRow(horizon, before, after, *bounds, unit, noise)


def diagnosed(position, heading, *, effects=(DELAY,), verdict=Verdict.EFFECT_FOUND, **more):
    gap = {"position_2s": row(*position), "heading_2s": row(*heading, unit="deg", noise=0.3)}
    return Diagnosis(verdict, effects=effects, gap=gap, fitted=tuple((e.name, {}) for e in effects), **more)


def test_an_explained_error_is_good_and_what_is_left_is_said_first():
    top = headline(diagnosed((0.5, 0.06), (8.0, 1.0)))
    assert top.tone is Tone.GOOD and top.helps
    assert top.sentence == "The cause was found."
    assert top.unexplained == "Unexplained after 2 s: 10 % of the position error; 9 % of the heading error."
    assert top.findings == ("The drives react 0.30 s late to every command.",)
    assert any("0.28 to 0.32 s" in text for text in top.confidence)
    lines = summary_lines(diagnosed((0.5, 0.06), (8.0, 1.0)))
    assert lines[0].startswith("effect_found: ") and "Unexplained" in lines[1]


def test_an_error_as_small_as_the_healthy_robots_does_not_grow():
    """A turned sensor explains the position; the heading goes from 0.47° to 0.58° where a healthy robot has 0.7°."""
    turned = effect("sensor_yaw_offset", angle=(0.09, 0.06, 0.12))
    found = diagnosed((0.2, 0.01), (0.47, 0.58), effects=(turned,))
    found = replace(found, gap={**found.gap, "heading_2s": row(0.47, 0.58, unit="deg", noise=0.15)})
    assert headline(found).tone is Tone.PARTLY and "grew" in headline(found).unexplained
    known = headline(replace(found, healthy={"position": 0.012, "heading": 0.7}))
    assert known.tone is Tone.GOOD and known.helps
    assert "the heading error was no larger than the healthy robot's before" in known.unexplained
    # One that grows beyond the healthy robot's is said.
    grown = replace(found, gap={**found.gap, "heading_2s": row(0.47, 0.9, unit="deg", noise=0.15)})
    assert "grew" in headline(replace(grown, healthy={"position": 0.012, "heading": 0.4})).unexplained


def test_a_robot_that_was_blocked_is_not_all_right_because_its_model_is():
    seen = "the wheels turn (9.3 m) but the robot stays where it is (within 0.02 m)"
    gap = {"position_2s": row(0.02, None), "heading_2s": row(0.5, None, unit="deg", noise=0.3)}
    blocked = Diagnosis(Verdict.NO_DISCREPANCY, gap=gap, observed=(seen,))
    top = headline(blocked)
    assert top.tone is Tone.PARTLY and top.findings == (seen,) and "Nothing is wrong" not in top.sentence
    assert any(seen in line for line in summary_lines(blocked))
    assert "but the robot stays where it is" in diagnosis_page(blocked, {}, None)
    assert headline(replace(blocked, observed=())).tone is Tone.GOOD


@pytest.mark.parametrize(("share", "said"), [(0.55, True), (0.3, False)])
def test_what_explains_most_of_an_unknown_effect_is_said_with_its_share(share, said):
    part = effect("drive_gain", gain=(1.12, 1.08, 1.16))
    found = Diagnosis(
        Verdict.UNKNOWN_EFFECT, known_parts=(part,), gap={"position_2s": row(0.16, None)},
        losses=Losses(4.5, 2.0, 0.69, share),
    )  # fmt: skip
    top = headline(found)
    assert top.tone is Tone.UNKNOWN
    assert any("55 %" in text and "12 % faster than commanded" in text for text in top.findings) == said
    assert top.sentence.startswith("Something is wrong; what is known explains a part of it") == said


def test_what_no_search_without_a_part_finds_is_not_said_to_explain_too_little():
    part = effect("drive_gain", gain=(1.12, 1.08, 1.16))
    found = Diagnosis(
        Verdict.UNKNOWN_EFFECT, known_parts=(part,), gap={"position_2s": row(0.16, None)},
        losses=Losses(4.5, 0.8, 0.69, 0.96), not_found_again=True,
    )  # fmt: skip
    top = headline(found)
    assert "hangs on a part of the recording" in top.sentence and not any("96 %" in text for text in top.findings)
    assert any("searches without a part of it do not find" in text for text in top.findings)


def test_what_is_less_than_in_the_robots_file_is_said_to_be_less():
    late = replace(DELAY, in_file={"delay": 0.5})
    text = "The drives react 0.30 s late to every command. The robot's file says delay 0.5 s, which is more."
    assert finding(late) == text
    top = headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(late,)))
    assert any("less than in the robot's file" in text and "commission" in text for text in top.actions)
    # Within the interval nothing has changed, and factors and forces have no least size.
    for estimate in (
        replace(DELAY, in_file={"delay": 0.31}),
        replace(effect("drive_gain", gain=(1.03, 1.02, 1.04)), in_file={"gain": 1.15}),
        replace(effect("constant_force", x=(9.9, 8.0, 11.0), y=(200.0, 190.0, 210.0)), in_file={"x": 10.0, "y": 0.0}),
    ):
        assert "which is more" not in finding(estimate)
    later = replace(DELAY, in_file={"delay": 0.1})
    assert finding(later).endswith("The robot's file says delay 0.1 s.")
    assert remedy("command_delay") in headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(later,))).actions


def test_what_the_localisation_errs_by_itself_is_said_beside_what_is_unexplained():
    floor = NoiseFloor(2.0, 0.01, 0.01, 0.02)
    found = diagnosed((0.5, 0.06), (20.0, 8.0), localisation_error=7.3, noise_floor=floor)
    assert "Poses and gyro turn 7.3° apart within 2 s" in headline(found).unexplained
    assert "7.3°" in diagnosis_page(found, {}, None)
    assert report_content(found, {}, None)["localisation_error_deg"] == 7.3
    assert "gyro" not in headline(diagnosed((0.5, 0.06), (20.0, 8.0), noise_floor=floor)).unexplained


def test_what_a_sensor_measures_of_itself_leaves_nothing_of_the_motion_unexplained():
    bias = effect("gyro_bias", bias=(0.041, 0.0405, 0.042))
    found = replace(
        diagnosed((0.018, None), (0.3, None), effects=(bias,)),
        fitted=(),
        gap={
            "position_2s": row(0.018, None),
            "heading_2s": row(0.3, None, unit="deg", noise=0.3),
            "yaw_rate_gyro": row(0.042, 0.003, unit="rad/s", noise=0.003, horizon=0.0),
        },
        commissioned=True,
    )
    top = headline(found)
    assert top.tone is Tone.GOOD and top.unexplained == "" and "A sensor shows what is wrong" in top.sentence
    assert any("gyro" in text for text in top.findings)
    assert headline(found, ["the map ends"]).tone is Tone.PARTLY
    assert "nexplained" not in "\n".join(summary_lines(found)) + diagnosis_page(found, {}, None)


def test_a_short_held_out_recording_or_a_motion_that_stays_unexplained_is_no_sensor_fault_alone():
    top = headline(replace(diagnosed((0.5, 0.4), (8.0, 7.0)), held_out={"short": {}}))
    assert top.tone is Tone.PARTLY and "Most of the error is not explained" in top.sentence
    assert "80 % of the position error" in top.unexplained
    lost = effect("blocked_flipper", front_left=(0.9, 0.85, 0.95))
    found = diagnosed((0.5, None), (20.0, None), effects=(lost,))
    found = replace(found, fitted=(), motion_unexplained=True)
    top = headline(found)
    assert top.tone is Tone.PARTLY and "does not move as predicted" in top.sentence
    assert top.unexplained == "Unexplained: all of the error."


def test_a_part_of_the_recording_is_said_beside_what_acts_there():
    there = "It acts within 2.5 m of (7.3, 3.3) in the odometry frame (26 of 86 windows)."
    found = diagnosed((0.5, 0.06), (8.0, 1.0), part=there)
    top = headline(found)
    assert top.findings == ("The drives react 0.30 s late to every command.", there)
    assert there in "\n".join(summary_lines(found)) and there in diagnosis_page(found, {}, None)
    assert report_content(found, {}, None)["part"] == there
    assert report_content(diagnosed((0.5, 0.06), (8.0, 1.0)), {}, None)["part"] is None


ICE = effect("friction_scale", factor=(0.15, 0.1, 0.2))
PATCH = "It acts within 2.5 m of (7.3, 3.3) in the odometry frame (26 of 86 windows)."


def test_what_acts_on_a_part_of_the_ground_is_written_into_a_robot_file_only_if_it_is_asked_for(tmp_path):
    found = diagnosed((0.5, 0.06), (8.0, 1.0), effects=(DELAY, ICE), part=PATCH, partial=(ICE.name,), regional=True)
    # What a sensor measured acts everywhere.
    assert effects_for_file(found) == (DELAY,)
    assert effects_for_file(found, local=True) == (DELAY, ICE)
    for local, said in ((False, "not written into a robot file"), (True, "new file on such ground only")):
        advised = with_advice(found, local=local)
        for text in ("\n".join(summary_lines(advised)), diagnosis_page(advised, {}, None)):
            assert said in text
            assert "on all other ground predictions get worse with it" in text
    assert report_content(found, {}, None)["partial"] == ["friction_scale"]
    # The report of a file says what that one holds.
    for written in ((DELAY, ICE), (DELAY,)):
        names = [entry.name for entry in written]
        page = diagnosis_page(found, {}, tmp_path / "husky.yaml", (), names)
        assert ("robot file with the added effects" in page) is (len(written) == 2)
        only = "o predict with command_delay, give husky.yaml of this folder as the robot; friction_scale is not in it"
        assert (only in page) is (len(written) == 1)
        assert ("robot file with command_delay" in page) is (len(written) == 1)
        assert report_content(found, {}, tmp_path / "husky.yaml", (), names)["in_robot_file"] == names
    assert report_content(found, {}, None)["in_robot_file"] == []
    file = write_robot("husky", tmp_path / "husky.yaml", [file_entry(found, e) for e in (DELAY, ICE)], [], "0")
    lines = file.read_text().splitlines()
    above = [lines[lines.index(f"- name: {name}") - 1] for name in ("command_delay", "friction_scale")]
    assert not above[0].startswith("#")
    assert above[1].startswith("# friction_scale: It acts within 2.5 m") and "predictions get worse" in above[1]
    assert dict(load_robot(file).effects)["friction_scale"] == {"factor": 0.15}
    # The comment stays in copies of the file.
    again = write_robot(file, tmp_path / "again.yaml", [], [], "0")
    assert above[1] in again.read_text().splitlines()


def test_what_began_in_the_middle_describes_the_robot_since_then():
    since = "It begins 43 s after the start; these figures are of the time after that."
    found = diagnosed((0.5, 0.06), (8.0, 1.0), part=since, partial=(DELAY.name,))
    assert effects_for_file(found) == (DELAY,)
    assert (
        file_entry(found, DELAY)["part"].startswith("It begins 43 s") and "before" in file_entry(found, DELAY)["part"]
    )
    assert any("the motion before that is predicted worse" in action for action in headline(with_advice(found)).actions)
    whole = diagnosed((0.5, 0.06), (8.0, 1.0))
    assert with_advice(whole) is whole and "part" not in file_entry(whole, DELAY)


@pytest.mark.parametrize(
    ("position", "heading", "sentence"),
    [
        ((0.5, 0.45), (8.0, 7.2), "Most of the error is not explained"),  # a tenth
        ((0.5, 0.51), (8.0, 7.9), "predictions get worse"),  # a position gain of -2 %
        ((0.5, 0.1), (8.0, 12.0), "but with it the heading error grows|Most of the error is not"),
        ((0.5, 0.2), (8.0, 7.0), "Most of the error is not explained"),  # the heading is not explained
    ],
)
def test_a_small_share_or_a_grown_error_is_never_good(position, heading, sentence):
    top = headline(diagnosed(position, heading))
    assert top.tone is not Tone.GOOD
    assert re.search(sentence, top.sentence)
    grown = position[1] > position[0] or heading[1] > heading[0]
    assert any("grows with these effects" in text for text in top.doubts) == grown
    assert top.helps == (not grown)
    assert any("do not use what was found yet" in text for text in top.actions) == grown
    # Neither is the page green, whatever the search says of the share of its own loss.
    assert "#0b6e4f'" not in diagnosis_page(diagnosed(position, heading), {}, None)


def test_an_effect_that_one_part_of_the_recording_shows_is_not_good():
    for times, sure in (((3, 3), True), ((2, 3), True), ((1, 3), False)):
        top = headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(replace(DELAY, found_again=times),)))
        assert (top.tone is Tone.GOOD) == sure
        assert any("in a part of the recording only" in text for text in top.doubts) == (not sure)
        assert any(f"found again in {times[0]} of 3 searches" in text for text in top.confidence)


def test_a_name_that_changes_with_the_part_of_the_recording_is_said_as_one_class():
    slow = effect("drive_gain", gain=(0.9, 0.85, 0.95))
    unstable = replace(slow, found_again=(1, 3), named_otherwise=("turning_scrub", "payload"))
    found = diagnosed((0.5, 0.06), (8.0, 1.0), effects=(unstable,))
    top = headline(found)
    assert top.tone is Tone.PARTLY and "the name of its cause changes" in top.sentence
    names = f"{cause('drive_gain')}, {cause('turning_scrub')} or {cause('payload')}"
    (text,) = top.findings
    assert text.startswith(f"The name changes with the part of the recording: {names}. By all of it: ")
    assert any(names in doubt for doubt in top.doubts)
    assert not any("in a part of the recording only" in doubt for doubt in top.doubts)
    assert f"if it is {cause('payload')} instead: {remedy('payload')}" in top.actions
    assert names in "\n".join(summary_lines(found)) and names in diagnosis_page(found, {}, None)
    assert report_content(found, {}, None)["effects"][0]["named_otherwise"] == ["turning_scrub", "payload"]
    alone = headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(replace(unstable, named_otherwise=()),)))
    assert any("in a part of the recording only" in doubt for doubt in alone.doubts)


def test_what_is_held_out_is_said_as_it_is():
    """Only in a short recording were the effects selected on the blocks that judge them."""
    short, long = (diagnosed((0.5, 0.06), (8.0, 1.0), repeated=repeated) for repeated in (False, True))
    pages = [diagnosis_page(found, {}, None) for found in (short, long)]
    assert ["selected on these same blocks" in page for page in pages] == [True, False]
    assert ["never saw its part of the recording" in page for page in pages] == [False, True]
    sizes = [" ".join(headline(found).confidence) for found in (short, long)]
    assert ["held-out parts of this recording" in text for text in sizes] == [False, True]
    assert "blocks of this recording left out of the fit" in sizes[0]
    # Nothing was fitted: nothing is held out.
    assert "never saw" not in diagnosis_page(replace(diagnosed((0.5, None), (8.0, None)), fitted=()), {}, None)
    within = diagnosis_page(replace(long, part="It begins 40 s after the start."), {}, None)
    assert "chosen on the whole recording" in within and "chosen on the whole" not in pages[1]


def test_a_robot_that_was_never_commissioned_is_a_doubt():
    known, unknown = (headline(diagnosed((0.5, 0.06), (8.0, 1.0), commissioned=it)) for it in (True, False))
    assert not known.doubts and "never commissioned" in unknown.doubts[0]
    assert not known.of_file and unknown.of_file
    assert any("commission the robot" in text for text in unknown.actions)
    assert not any("commission" in text for text in known.actions)
    # How a robot differs from a file that nobody fitted to it need not be wrong.
    pages = [diagnosis_page(diagnosed((0.5, 0.06), (8.0, 1.0), commissioned=it), {}, None) for it in (True, False)]
    assert ["What is wrong" in page for page in pages] == [True, False]
    assert "What differs from the robot file" in pages[1]


def test_a_robot_that_was_never_commissioned_is_not_green_and_that_is_said_first():
    found = headline(diagnosed((0.5, 0.06), (8.0, 1.0), commissioned=False), ["the ground is not level"])
    assert found.tone is Tone.PARTLY and "never commissioned" in found.doubts[0]
    alone = headline(diagnosed((0.5, 0.06), (8.0, 1.0), commissioned=False))
    assert alone.tone is Tone.PARTLY and alone.sentence.startswith("The robot was never commissioned: one ")
    nothing = headline(Diagnosis(Verdict.NO_DISCREPANCY, commissioned=False))
    assert nothing.tone is Tone.PARTLY and nothing.sentence.startswith("The robot was never commissioned")
    assert "never commissioned" in nothing.doubts[0] and any("commission the robot" in text for text in nothing.actions)
    doubtful = headline(Diagnosis(Verdict.NO_DISCREPANCY, commissioned=False), ["the ground is not level"])
    # Nobody knows how large the healthy robot's errors are.
    assert "healthy robot's" not in doubtful.sentence


def test_errors_that_grow_a_little_are_not_said_to_grow_from_a_number_to_itself():
    top = headline(diagnosed((0.5, 0.06), (2.41, 2.44)))
    assert any("from 2.41 to 2.44 deg" in text for text in top.doubts)
    assert any("2.41 → 2.44°" in text for text in top.confidence)


def test_causes_that_a_recording_cannot_tell_apart_are_not_called_the_cause_and_each_has_a_remedy():
    both = effect("command_delay", delay=(0.3, 0.28, 0.32), indistinguishable=("command_clock_offset",))
    top = headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(both,)))
    assert "cannot tell" in top.sentence and "The cause was found" not in top.sentence
    assert "if it is a wrong command clock instead: synchronise the clocks of planner and base" in top.actions
    # To record an IMU is advice for a recording without one.
    without, with_gyro = (advice(Verdict.EFFECT_FOUND, [both], gyro=gyro) for gyro in (False, True))
    assert any("IMU" in text for text in without) and not any("IMU" in text for text in with_gyro)
    assert any("synchronise the clocks" in text for text in with_gyro)


def test_a_page_gives_angles_in_degrees_and_no_share_of_noise():
    found = diagnosed((0.5, 0.06), (8.0, 1.0), localisation=(
        Localisation("heading error", "turning", 2.0, 0.7, 0.4, 0.1, -0.01, "rad", 2.0),
    ))  # fmt: skip
    noisy = GapRow(2.0, 0.015, 0.02, -0.01, 0.001, "deg", 0.014, -0.5)
    page = diagnosis_page(replace(found, gap={**found.gap, "lean_2s": noisy}), {"recording_s": 40.0}, None)
    assert "RMS 5.7°, mean -0.57°" in page and " rad" not in page
    assert "-50 %" not in page and "length of the recording [s]" in page


def test_a_held_out_recording_from_before_the_fault_leaves_the_cause_open():
    held_out = {"monday": {"position_2s": row(0.003, 0.07), "heading_2s": row(0.1, 3.0, "deg", 0.02)}}
    before = diagnosed((0.5, 0.05), (8.0, 0.8), held_out=held_out, healthy={"position": 0.01, "heading": 0.5})
    top = headline(before)
    assert top.tone is Tone.PARTLY and top.sentence.startswith("A cause was found, but the held-out recordings")
    assert top.actions[0].startswith("if the held-out recordings were driven with the same fault") and not top.helps


def test_factors_have_no_unit():
    scrub = effect("turning_scrub", track_width_factor=(0.83, 0.75, 0.91))
    found = diagnosed((0.5, 0.06), (8.0, 1.0), effects=(scrub,))
    assert any("track_width_factor 0.83 (0.75 to 0.91)" in line for line in summary_lines(found))
    assert "<b>0.83</b></td>" in diagnosis_page(found, {}, None)


def test_names_of_effects_keep_their_letters_in_a_report():
    remarks = ("drive_gain explains 93 % of the excess loss", "the rest is as a healthy robot's")
    page = diagnosis_page(replace(diagnosed((0.5, 0.06), (8.0, 1.0)), remarks=remarks), {}, None)
    assert "<li>drive_gain explains 93 %" in page and "<li>The rest is as" in page


def test_held_out_recordings_go_before_blocks_of_the_diagnosed_one():
    held_out = {"tuesday": {"position_2s": row(0.4, 0.39), "heading_2s": row(6.0, 5.9, "deg", 0.3)}}
    top = headline(diagnosed((0.5, 0.05), (8.0, 0.8), held_out=held_out))
    assert top.tone is Tone.PARTLY
    assert "97 % of the position error on tuesday" in top.unexplained
    shares = {entry.metric: entry.share for entry in explained(diagnosed((0.5, 0.05), (8.0, 0.8)))}
    assert shares == {"position": pytest.approx(0.918, abs=1e-3), "heading": pytest.approx(0.935, abs=1e-3)}


def test_an_error_within_the_noise_needs_no_explanation():
    top = headline(diagnosed((0.5, 0.06), (0.4, 0.41)))
    assert top.tone is Tone.PARTLY  # beyond chance, the heading grew
    calm = diagnosed((0.5, 0.06), (0.4, 0.39))
    assert headline(calm).tone is Tone.GOOD
    assert "the heading error was hardly above the noise before" in headline(calm).unexplained


@pytest.mark.parametrize("verdict", list(Verdict))
def test_every_verdict_has_a_sentence_a_page_and_a_tone(verdict):
    adds = verdict in (Verdict.EFFECT_FOUND, Verdict.UNKNOWN_EFFECT)
    after = (0.1, 1.5) if adds else (None, None)
    formula = EffectEstimate("learned_term", {"torque_z:vx": ParameterEstimate(231.0, 229.0, 232.0, "N m")})
    effects = {Verdict.EFFECT_FOUND: (DELAY,), Verdict.UNKNOWN_EFFECT: (formula,)}.get(verdict, ())
    diagnosis = diagnosed((0.5, after[0]), (8.0, after[1]), effects=effects, verdict=verdict, advice=("drive longer",))
    top = headline(diagnosis)
    assert (top.tone is Tone.GOOD) == (verdict in (Verdict.EFFECT_FOUND, Verdict.NO_DISCREPANCY))
    inputs = {"bag": "monday", "robot": "husky", "recording_s": 61.0, "driven_m": 30.5}
    page = diagnosis_page(diagnosis, inputs, None)
    first = page[: page.index("<section class='card result'")]
    assert "monday" in first and "husky" in first and "61.0 s, 30.5 m driven" in first
    if after[0] is None and verdict == Verdict.NO_IMPROVEMENT:
        assert top.unexplained == "Unexplained: all of the error."
    assert top.sentence in page and "drive longer" in page.lower()
    assert report_content(diagnosis, inputs, None)["headline"]["tone"] == top.tone
    if verdict == Verdict.UNKNOWN_EFFECT:
        assert "no known effect" in top.sentence and "torque_z = 231 vx" in top.findings[0]


def test_nothing_is_lost_that_has_no_room_on_the_first_screen():
    hints = tuple(f"record manoeuvre number {number:02d}" for number in range(12))
    page = diagnosis_page(diagnosed((0.5, 0.1), (8.0, 1.5), advice=hints), {}, None).lower()
    for hint in hints:
        assert page.count(hint) == 1, hint
    assert page.index("also</h2>") < page.index(hints[-1])
    assert "also</h2>" not in diagnosis_page(diagnosed((0.5, 0.1), (8.0, 1.5)), {}, None).lower()


@pytest.mark.parametrize(
    ("one", "other"), [("actuator_deadband", "rolling_resistance"), ("rolling_resistance", "constant_force")]
)
def test_a_class_of_causes_comes_with_the_manoeuvre_that_separates_them(one, other):
    parameters = {p.name: (p.neutral + p.scale, p.neutral, p.neutral + 2 * p.scale) for p in CATALOGUE[one].parameters}
    hints = advice(Verdict.EFFECT_FOUND, [effect(one, indistinguishable=(other,), **parameters)])
    assert any(f"would distinguish {one} from {other}" in hint for hint in hints)


def test_every_pair_of_effects_has_a_manoeuvre_or_a_sensor():
    names = [entry.name for entry in identifiable_effects()]
    for one in names:
        for other in names:
            if one != other:
                assert separating_manoeuvre(one, other) or separating_sensor(one, other), (one, other)


def test_a_model_that_misses_the_healthy_robot_does_not_say_that_nothing_is_wrong():
    nothing = Diagnosis(Verdict.NO_DISCREPANCY)
    assert headline(nothing, []).sentence.startswith("Nothing is wrong")
    top = headline(nothing, ["the commissioned model misses the healthy robot by 17 cm"])
    assert top.tone is Tone.PARTLY and "with doubts" in top.sentence


def test_an_error_without_a_name_on_hills_without_a_map_is_not_called_an_effect():
    reason = "the ground is not level and no map shows it"
    formula = replace(DELAY, name="learned_term")
    nameless = [
        diagnosed((0.5, None), (8.0, None), effects=(), verdict=Verdict.UNKNOWN_EFFECT, commissioned=False),
        diagnosed((0.5, 0.3), (8.0, 6.0), effects=(formula,), verdict=Verdict.UNKNOWN_EFFECT),
        diagnosed((0.5, None), (8.0, None), effects=(), verdict=Verdict.UNKNOWN_EFFECT, known_parts=(DELAY,)),
    ]
    for found in nameless:
        judged = without_blame_for_ground(found, reason, named=False)
        assert judged.verdict is Verdict.NOT_IDENTIFIABLE and judged.commissioned is found.commissioned
        assert judged.known_parts == found.known_parts and not judged.effects
        top = headline(judged)
        assert top.sentence == "This recording cannot be diagnosed." and top.findings == (reason,)
        assert "ground is not level" in diagnosis_page(judged, {}, None)
        # On a map, or on level ground, it is the robot's.
        assert without_blame_for_ground(found, "", named=True) is found
    # What has a name stands, and so does a healthy robot.
    for kept in (diagnosed((0.5, 0.06), (8.0, 1.0)), Diagnosis(Verdict.NO_DISCREPANCY)):
        assert without_blame_for_ground(kept, reason, named=True) is kept
    # Forces that slopes exert may pass for effects, where the robot is not known on slopes. Delays may not, nor what
    # only changes how the robot turns: a slope pulls whichever way that is.
    scrub = effect("turning_scrub", track_width_factor=(1.23, 1.16, 1.31))
    turns = diagnosed((0.5, 0.06), (8.0, 1.0), effects=(scrub, DELAY))
    assert without_blame_for_ground(turns, reason, named=True) is turns
    pull = effect("constant_force", x=(-40.0, -50.0, -30.0), y=(0.0, -5.0, 5.0))
    pulled = diagnosed((0.5, 0.06), (8.0, 1.0), effects=(pull, DELAY))
    assert without_blame_for_ground(pulled, reason, named=False) is pulled
    judged = without_blame_for_ground(pulled, reason, named=True)
    assert judged.verdict is Verdict.NOT_IDENTIFIABLE and judged.known_parts == (pull, DELAY) and not judged.fitted
    assert judged.advice == (
        reason, "on known ground this would mean: Something pulls the robot with 40 N backward all the time.",
    )  # fmt: skip


def test_ground_that_is_steeper_than_where_the_robot_was_commissioned_gets_a_doubt():
    degree = math.radians(1.0)
    assert beyond_commissioning(6.0 * degree, 0.5 * degree).startswith(
        "the robot was commissioned on ground with slopes of 0.5°"
    )
    assert "commission it with a recording of such ground" in beyond_commissioning(6.0 * degree, 4.0 * degree)
    # About as steep, level, or unknown.
    for slope, commissioned in ((5.0, 4.0), (2.5, 0.1), (2.0, 4.0)):
        assert not beyond_commissioning(slope * degree, commissioned * degree)
    assert not beyond_commissioning(10.0 * degree, None)


def test_doubts_take_the_green_away():
    ground = "the ground is not level, and there is no map of it"
    top = headline(diagnosed((0.5, 0.06), (8.0, 1.0)), [ground])
    assert top.tone is Tone.PARTLY and ground in top.doubts
    assert top.actions[0].startswith("remove the cause of the doubt") and not any(
        "robot file" in t for t in top.actions
    )
    arm = effect("sensor_lever_arm", x=(0.16, -0.2, 0.5), y=(2.0, 0.17, 2.0))
    both = diagnosed((0.5, 0.06), (8.0, 1.0), effects=(DELAY, arm))
    top = headline(both)
    assert top.tone is Tone.PARTLY and not top.helps
    assert len(top.findings) == 1 and any("sensor_lever_arm" in text for text in top.doubts)
    page = diagnosis_page(both, {}, None)
    assert page.index("Effects missing in the model") < page.index("Fitted, but not established")
    assert headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(arm,))).tone is Tone.UNKNOWN
    late = effect("command_delay", delay=(0.3, 0.28, 0.32), indistinguishable=("pose_clock_offset",))
    assert any("late poses" in text for text in headline(diagnosed((0.5, 0.06), (8.0, 1.0), effects=(late,))).doubts)


@pytest.mark.parametrize(
    "estimate",
    [
        effect("friction_scale", factor=(0.02, 0.02, 0.05)),
        effect("turning_scrub", track_width_factor=(4.0, 3.6, 4.0)),
        effect("sensor_lever_arm", x=(0.1, 0.05, 0.2), y=(-2.0, -2.0, -1.9)),
        effect("sensor_lever_arm", x=(0.1, -0.1, 0.3), y=(0.2, -0.1, 0.5)),
        effect("payload", mass=(5.0, -1.0, 11.0), x=(0.4, 0.3, 0.5), y=(0.0, -0.1, 0.1)),
        effect("rolling_resistance", coefficient=(0.01, 0.0, 0.05)),
        effect("actuator_saturation", limit=(9.0, 2.0, 20.0)),
        effect("command_delay", delay=(float("nan"), 0.0, 1.0)),
    ],
    ids=lambda estimate: estimate.name,
)
def test_bounds_and_intervals_that_hold_neutral_are_no_findings(estimate):
    assert complaint(estimate).startswith(f"{estimate.name}: ")


@pytest.mark.parametrize(
    "estimate",
    [
        DELAY,
        effect("friction_scale", factor=(0.1, 0.05, 0.2)),
        effect("constant_force", x=(3.0, -5.0, 11.0), y=(91.0, 80.0, 102.0)),
        effect("payload", mass=(17.0, 10.0, 24.0), x=(0.0, -0.1, 0.1), y=(0.0, -0.1, 0.1)),
        effect("actuator_saturation", limit=(0.6, 0.58, 0.62)),
        effect("rolling_resistance", coefficient=(0.2, 0.15, 0.25)),
        # The whole of a share: a dead drive, a flipper that does not move.
        effect("drive_loss", loss=(-1.0, -1.0, -0.97)),
        effect("blocked_flipper", front_left=(0.0, 0.0, 0.0), rear_right=(1.0, 0.98, 1.02)),
    ],
    ids=lambda estimate: estimate.name,
)
def test_measurements_are_not_complained_about(estimate):
    assert complaint(estimate) == ""


def test_an_unknown_effect_or_parameter_is_refused():
    with pytest.raises(ValueError, match="expected one of the catalogue"):
        complaint(EffectEstimate("command_dealy", DELAY.parameters))
    with pytest.raises(ValueError, match=r"expected \['delay'\]"):
        complaint(EffectEstimate("command_delay", {"time": ParameterEstimate(0.3, 0.2, 0.4, "s")}))


@pytest.mark.parametrize("name", [known.name for known in identifiable_effects()])
def test_every_effect_is_said_in_words(name):
    kind = CATALOGUE[name]
    for values in kind.first_values(load_robot("husky")):
        units = {parameter.name: parameter.unit for parameter in kind.parameters}
        estimate = EffectEstimate(name, {k: ParameterEstimate(v, v, v, units[k]) for k, v in values.items()})
        text = finding(estimate)
        assert text.endswith(".") and text[0].isupper() and name not in text
        assert not text.startswith(kind.summary.rstrip("."))
    assert remedy(name) != remedy("none of them") and cause(name) != name.replace("_", " ")


@pytest.mark.parametrize(
    ("estimate", "text"),
    [
        (effect("pose_clock_offset", offset=(0.4, 0.3, 0.5)), "The poses are stamped 0.40 s late."),
        (effect("pose_clock_offset", offset=(-0.2, -0.3, -0.1)), "The poses are stamped 0.20 s early."),
        (effect("turning_scrub", track_width_factor=(2.0, 1.9, 2.1)), "The robot turns 50 % less than"),
        (effect("drive_asymmetry", difference=(0.1, 0.1, 0.1)), "The right side runs 10 % faster than the left"),
        (effect("drive_loss", loss=(-0.4, -0.5, -0.3)), "the right side run 40 % slower"),
        (effect("drive_loss", loss=(1.0, 1.0, 1.0)), "the left side do not run"),
        (effect("rotation_centre", x=(-0.1, -0.2, -0.05)), "a point 0.10 m behind the one"),
        (effect("constant_force", x=(1.0, 0, 2), y=(-90.0, -95, -85)), "pulls the robot with 90 N to the right all"),
    ],
)
def test_sentences_have_the_right_sign(estimate, text):
    assert text in finding(estimate)
    assert "ahead" not in finding(estimate)


def test_the_first_screen_has_no_empty_columns():
    """Of a recording that cannot be diagnosed nothing is more or less sure."""
    refused = Diagnosis(Verdict.NOT_IDENTIFIABLE, advice=("the robot does not move",))
    page = diagnosis_page(refused, {"bag": "yard"}, None)
    assert "What is wrong" in page and "What to do" in page
    assert "How sure" not in page
    assert "'></ul>" not in page and "<ul></ul>" not in page
