"""Thresholds: every number that decides a verdict, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """Numbers that decide a verdict.

    Attributes:
        effect_rate: stated rate at which a healthy recording yields an effect, over all candidates together, half of it
            (``whole_rate``) one that acts in all of the recording, half of it (``part_rate``) one in a part of it.
        fit_rate: stated rate at which a healthy recording, or one whose effects are all known, yields
            ``unknown_effect``. Together with ``effect_rate`` it is the usual 5 % of false alarms.
        further_rate: stated rate at which a further effect is added though none is missing.
        comparison_rate: stated one-sided error rate when two explanations are compared on held-out windows.
        confidence: of the intervals.
        draws: draws from the null distribution. The standard error of a rate of 2.5 % is 0.8 % with 400 draws.
        block: length of blocks that count as independent [s]: twice the window of 2 s, so that windows of different
            blocks share at most one window's motion.
        drive_spread: standard deviation of the logarithm of the mean loss between healthy drives of one robot, beyond
            the standard errors of both means (:mod:`residual_size`): another drive has other commands and ground. At
            0.1, 0.15, 0.2, 0.25 and 0.3 of 74 empty drives of 37 platforms of both engines 15, 13, 11, 9 and 6 are more
            than one standard deviation larger, where 12 are expected, and 4, 3, 1, 1 and 1 are too large at half of
            ``fit_rate``, where 1 is (``benchmarks/platforms/null_rates.py``; files whose healthy loss was a mean of
            logarithms, to which half the variance of these was added).
        drive_share: variance of an effect's influence between healthy drives of one robot, as a share of that between
            segments of its commissioning drive. By their motion alone the same 60 drives show an effect at 0, 0.1,
            0.25, 0.35, 0.5 and 0.8 on 10, 8, 5, 3, 2 and 1 (the same command), where 1.5 are stated; diagnosed whole,
            with what gyro and wheels rule out, 4, 4, 3 and 1 of them raise an alarm at 0.25, 0.35, 0.5 and 0.8, where
            3 are stated (``effect_rate`` and ``fit_rate``). Of 41 drives with one effect 37 are significant at each of
            0.25 to 0.8; weak effects that begin late are lost at 0.8 (``test_onset.py``).
        calibration_degrees: degrees of freedom of these two: the number of platforms, for the two drives of each share
            a commissioning drive.
        model_error: error of an effect's formula as a share of what the effect changes, root mean square in any one
            direction: no formula holds exactly on another engine or robot. What the true effects leave, beside what
            they change, is 0.30 (root mean square; median 0.08) on the 75 singles and pairs of the 30 MuJoCo platforms
            for choosing, and 0.29 (median 0.14) on 23 of ten Newton platforms, with which it was not chosen
            (``benchmarks/platforms/true_effects.py``).
        formula_error: standard deviation of an effect's value because its formula is not exact, as a share of the
            value's distance from no effect. With 0, 0.05, 0.1, 0.15, 0.2 and 0.3 of it 37, 88, 95, 95, 95 and 95 % of
            the intervals hold the truth on 41 parameters that were named on MuJoCo platforms for choosing
            (``benchmarks/platforms/interval_error.py``). It is the smallest with 90 % of an earlier calibration, which
            took what commissioning finds on the healthy robot for none, and is kept: intervals are none too narrow.
        smallest_share: smallest share of a loss that an effect must remove (of the loss without it, but at least the
            healthy robot's), or a rest must make up (of the nominal model's), to be reported: the loss is quadratic,
            so a twentieth of it is an error of less than a quarter (√0.05) of the error that was there.
        further_share: smallest share of what the effects found so far explain (of the loss) that a further one must
            explain: no formula is exact, and a second effect makes up for some of the first one's error. On the first
            38 singles, pairs and outside effects of the MuJoCo platforms for choosing that was 0.018, 0.020, 0.023,
            0.10, 0.16 and 0.25 for effects that were not there, and 0.05, 0.14, 0.18, 0.40, 0.51, 0.60 and 0.77 for
            second ones that were (``benchmarks/platforms/further_shares.py``).
        explained_share: smallest share of the excess loss, that above a healthy robot's mean and one standard deviation
            of it on a drive (:mod:`residual_size`), which effects must explain to be the explanation; what explains
            less is reported as a known part. Of what these leave a further effect must explain as much where that is no
            larger than on a healthy robot. On the 75 singles and pairs of the 30
            MuJoCo platforms for choosing the true effects explain at least 0.5, 0.6, 0.7, 0.8 and 0.9 of what exceeds
            the mean on 69, 67, 66, 61 and 57 (``benchmarks/platforms/true_effects.py``, by their motion alone). What a
            search takes for the cause of an effect outside the catalogue explained 0.06, 0.12, 0.14, 0.52 and 0.62 of
            it on five of these drives (``share_explained`` of run.py). Of explanations whose rest looked healthy, on
            all drives in MuJoCo, Newton and DART so far, four right ones (0.62 to 0.69) and two wrong ones (0.62, 0.66)
            lie between 0.6 and 0.7, a half-right and three wrong ones between 0.5 and 0.6: at 0.6 fewest verdicts are
            wrong.
        most_share: share of a loss that is most of it, by definition. Of a robot that was never commissioned nobody
            knows the healthy loss: there effects must not leave most of the loss, nor a formula explain most of that.
    """

    effect_rate: float = 0.025
    fit_rate: float = 0.025
    further_rate: float = 0.025
    comparison_rate: float = 0.05
    confidence: float = 0.95
    draws: int = 400
    block: float = 4.0
    drive_spread: float = 0.2
    calibration_degrees: float = 30.0
    drive_share: float = 0.5
    model_error: float = 0.3
    formula_error: float = 0.15
    smallest_share: float = 0.05
    further_share: float = 0.03
    explained_share: float = 0.6
    most_share: float = 0.5

    @property
    def whole_rate(self) -> float:
        """Of effects that act in all of a recording."""
        return 0.5 * self.effect_rate

    @property
    def part_rate(self) -> float:
        """Of effects that act in a part of a recording."""
        return self.effect_rate - self.whole_rate
