"""Recordings of ``hidden_effects.py``: injected faults and generation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

NOISE = {"none": (0.0, 0.0), "usual": (0.01, 0.5), "rough": (0.03, 1.5)}
"""Standard deviation of the poses [m, deg]."""
SINGLES = (
    ("command_delay:0.15", "command_delay:0.4"),
    ("actuator_lag:0.2", "actuator_lag:0.5"),
    ("actuator_saturation:0.35", "actuator_saturation:0.6"),
    ("actuator_deadband:0.08", "actuator_deadband:0.15"),
    ("drive_gain:0.9", "drive_gain:0.75"),
    ("drive_asymmetry:0.06", "drive_asymmetry:-0.15"),
    ("friction_scale:0.5", "friction_scale:0.25"),
    ("turning_scrub:1.3", "turning_scrub:1.7"),
    ("rolling_resistance:0.2", "rolling_resistance:0.5"),
    ("viscous_drag:150", "viscous_drag:400"),
    ("quadratic_drag:200", "quadratic_drag:600"),
    ("constant_force:-120", "constant_force:x=0,y=150"),
    ("gravity_tilt:0.1", "gravity_tilt:about_y=0,about_x=0.15"),
    ("payload:mass=15,x=-0.2,y=0,z=0.3", "payload:mass=25,x=-0.2,y=0.15,z=0.2"),
    ("pose_clock_offset:0.15", "pose_clock_offset:0.4"),
    ("command_clock_offset:-0.2",),
    ("sensor_yaw_offset:0.08", "sensor_yaw_offset:-0.2"),
    ("sensor_lever_arm:0.3", "sensor_lever_arm:x=-0.3,y=0.2"),
)
"""Each effect at two strengths."""
PAIRS = (
    ("command_delay:0.3", "turning_scrub:1.6"),
    ("actuator_lag:0.4", "drive_gain:0.8"),
    ("actuator_saturation:0.45", "command_delay:0.3"),
    ("drive_asymmetry:0.12", "actuator_lag:0.4"),
    ("sensor_lever_arm:0.4", "drive_gain:0.8"),
    ("pose_clock_offset:0.3", "drive_asymmetry:-0.12"),
    ("turning_scrub:1.6", "drive_gain:0.8"),
    ("sensor_yaw_offset:0.15", "actuator_lag:0.4"),
    ("actuator_deadband:0.12", "command_delay:0.3"),
    ("actuator_saturation:0.45", "turning_scrub:1.6"),
)
OUT_OF_CATALOGUE = (
    "fading_drive:40", "fading_drive:20", "gusting_wind:300", "gusting_wind:force=500,period=6",
    "eccentric_wheel:0.03", "eccentric_wheel:0.06", "sticky_turn:0.4", "sticky_turn:0.8", "speed_pull:200",
    "speed_pull:400",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One recording."""

    kind: str
    """``healthy`` (for commissioning), ``empty``, ``single``, ``pair`` or ``out-of-catalogue``."""
    hidden: tuple[str, ...]
    ground: str
    """``flat`` or ``hills``."""
    noise: str
    seed: int
    commands: str = "steps"
    duration: float = 60.0

    @property
    def name(self) -> str:
        """Name of its folder."""
        faults = "+".join(text.replace(":", "_").replace("=", "").replace(",", "_") for text in self.hidden)
        return f"{self.kind}-{self.ground}-{self.noise}-{self.seed}" + (f"-{faults}" if faults else "")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the injected faults."""
        return tuple(text.partition(":")[0] for text in self.hidden)


SEED = 40_000
"""First seed. Thresholds and rules were tuned on smaller seeds, which the benchmark does not use."""


def all_cases(first: int = SEED) -> list[Case]:
    """All recordings of the benchmark, starting at a first seed; each has a unique seed."""
    cases = [
        Case("healthy", (), ground, noise, first + 9000 + number)
        for number, (ground, noise) in enumerate(
            [("flat", "usual"), ("hills", "usual"), ("flat", "none"), ("flat", "rough")]
        )
    ]
    seed = first + 100
    for number in range(42):
        ground = "hills" if number % 4 == 3 else "flat"
        noise = {1: "none", 5: "rough"}.get(number % 8, "usual")
        commands = "sweep" if number % 7 == 6 else "steps"
        cases.append(Case("empty", (), ground, noise, seed + number, commands))
    seed = first + 300
    for number, strengths in enumerate(SINGLES):
        for which, text in enumerate(strengths):
            cases.append(Case("single", (text,), "flat", "usual", seed + 10 * number + which))
        # The stronger fault again, over hills and with different noise.
        cases.append(Case("single", (strengths[-1],), "hills", "usual", seed + 10 * number + 5))
        noise = "none" if number % 2 else "rough"
        cases.append(Case("single", (strengths[-1],), "flat", noise, seed + 10 * number + 6))
    cases += [
        Case("pair", pair, "hills" if n % 5 == 4 else "flat", "usual", first + 600 + n) for n, pair in enumerate(PAIRS)
    ]
    cases += [
        Case("out-of-catalogue", (text,), "hills" if n % 5 == 4 else "flat", "usual", first + 700 + n)
        for n, text in enumerate(OUT_OF_CATALOGUE)
    ]
    return cases


def record_case(case: Case, folder: Path) -> Path:
    """Create the recording unless it exists; returns the bag."""
    from monoforce_ros.synthetic import LidarSettings, TerrainSettings
    from monoforce_ros.synthetic.hidden import parse_hidden
    from monoforce_ros.synthetic.odometry import OdometrySettings
    from monoforce_ros.synthetic.recording import RecordingSettings, record

    bag = folder / case.name
    if bag.exists():
        return bag
    metres, degrees = NOISE[case.noise]
    hills = case.ground == "hills"
    terrain = TerrainSettings(bare=True, roughness=0.6) if hills else TerrainSettings(flat=True)
    settings = RecordingSettings(
        seed=case.seed,
        duration=case.duration,
        commands=case.commands,
        terrain=terrain,
        camera=None,
        lidar=LidarSettings(rate=2.0) if hills else None,
        odometry=OdometrySettings.slam(metres, math.radians(degrees)),
        hidden=tuple(parse_hidden(text) for text in case.hidden),
        labels=hills,
    )
    record(bag, settings)
    return bag
