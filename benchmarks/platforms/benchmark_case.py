"""Benchmark case: which platforms are drawn, and what is hidden in their drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from drawn_platform import Platform, draw_platform
from hidden_effect import KINDS, OUTSIDE, PAIRED, SINGLES, WITH_ONSET

SETS = {"choosing": (1_000, 60), "reporting": (900_310, 108)}
"""First seed and number of platforms of each set. Rules and thresholds are chosen on one and reported on the other.

Seeds from 900000 to 900151, and from 900300 to 900308, were reported once (docs/discrepancy.md) and are not used
again."""
ENGINES = ("mujoco", "newton")
WORLDS = {"choosing": (1_060, 5), "reporting": (900_245, 5)}
"""First seed of each set in the package's own worlds, whose engine is called ``worlds``, and empty drives on each kind
of ground. Seeds from 900228 to 900232, and from 900240 to 900244, were reported once and are not used again."""
WORLD_GROUNDS = ("mixed", "rigid", "grass", "yard", "bare")
CASE_KINDS = ("empty", "single", "pair", "outside", "stuck")
DURATION = 60.0
"""Of a drive [s]."""
_COMPATIBLE = frozenset({"friction_scale", "payload"})
"""Kinds that change the robot's build: at most one in a pair."""


@dataclass(frozen=True)
class Case:
    """One drive to be diagnosed.

    Attributes:
        set_name: of ``SETS``.
        platform_seed: seed of the platform.
        number: of the drive on its platform.
        engine: of ``ENGINES``, or ``worlds``.
        ground: ``level`` or ``hills``, in worlds of ``WORLD_GROUNDS``.
        kind: of ``CASE_KINDS``.
        effects: names of the kinds that are hidden.
        late: whether the effect begins in the middle of the drive.
    """

    set_name: str
    platform_seed: int
    number: int
    engine: str
    ground: str
    kind: str
    effects: tuple[str, ...] = ()
    late: bool = False

    @property
    def platform_name(self) -> str:
        """Name of the platform's folder."""
        return f"{self.engine}-{self.ground}-{self.platform_seed}"

    @property
    def name(self) -> str:
        """Unique name."""
        hidden = "+".join(self.effects) + ("-late" if self.late else "")
        return "-".join(part for part in (self.platform_name, f"{self.number:02d}", self.kind, hidden) if part)

    @property
    def seed(self) -> int:
        """Seed of its draws."""
        return self.platform_seed * 100 + self.number


def all_cases(set_name: str) -> list[Case]:
    """The cases of a set, platform by platform.

    Every platform has two empty drives and two with one effect, and most have one with two effects and one with an
    effect outside the catalogue. Kinds take turns on each engine in an order that the set's seed shuffles.
    """
    first, count = SETS[set_name]
    turns = {engine: _Turns(first + number) for number, engine in enumerate(ENGINES)}
    cases: list[Case] = []
    for index in range(count):
        engine = ENGINES[index % 2]
        ground = "hills" if (index // 2) % 5 in (1, 3) else "level"
        seed = first + index
        platform = draw_platform(seed)
        turn = turns[engine]
        plan: list[tuple[str, tuple[str, ...], bool]] = [("empty", (), False), ("empty", (), False)]
        plan += [("single", (turn.single(platform),), False)]
        late = (index // 2) % 5 == 2
        plan += [("single", (turn.late() if late else turn.single(platform),), late)]
        if (index // 2) % 3 != 1:
            plan.append(("pair", turn.pair(), False))
        if (index // 2) % 3 != 2:
            plan.append(("outside", (turn.outside(),), False))
        if platform.wheels is not None and ground == "level" and (index // 2) % 4 == 0:
            plan.append(("stuck", ("wheels_in_the_air",), False))
        cases += [
            Case(set_name, seed, number, engine, ground, kind, effects, is_late)
            for number, (kind, effects, is_late) in enumerate(plan, start=1)
        ]
    first, drives = WORLDS[set_name]
    for number, ground in enumerate(WORLD_GROUNDS):
        seed = first + number
        cases += [Case(set_name, seed, drive, "worlds", ground, "empty") for drive in range(1, drives + 1)]
    return cases


class _Turns:
    """Kinds that take turns in a shuffled order."""

    def __init__(self, seed: int):
        random = np.random.default_rng([seed, 9])
        pairs = [
            (one, other)
            for number, one in enumerate(PAIRED)
            for other in PAIRED[:number]
            if not {one, other} <= _COMPATIBLE
        ]
        self._singles = [str(name) for name in random.permutation(SINGLES)]
        self._late = [str(name) for name in random.permutation(WITH_ONSET)]
        self._outside = [str(name) for name in random.permutation(OUTSIDE)]
        self._pairs = [pairs[index] for index in random.permutation(len(pairs))]

    def single(self, platform: Platform) -> str:
        """The next kind that the platform's sensors can show."""
        can_show = {"": True, "gyro": platform.gyro is not None, "wheels": platform.wheels is not None}
        name = next(name for name in self._singles if can_show[KINDS[name].needs])
        self._singles.remove(name)
        self._singles.append(name)
        return name

    def late(self) -> str:
        """The next kind that begins in the middle of a drive."""
        self._late.append(self._late.pop(0))
        return self._late[-1]

    def outside(self) -> str:
        """The next kind outside the catalogue."""
        self._outside.append(self._outside.pop(0))
        return self._outside[-1]

    def pair(self) -> tuple[str, str]:
        """The next pair."""
        self._pairs.append(self._pairs.pop(0))
        return self._pairs[-1]
