"""Settings of randomised worlds: what is drawn, from which range, in three styles.

Ranges are wider than what a user's site will show: a terrain encoder must not be able to learn a constant by heart.
Each field holds a distribution; ``WorldSettings.narrowed`` fixes single ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from monoforce_ros.synthetic.varied.distribution import Chance, Choice, Distribution, LogUniform, Uniform, Whole

DEGREE = math.pi / 180.0
GROUND_KINDS = (
    "meadow", "soil", "forest", "gravel", "sand", "mud", "snow", "ice", "asphalt", "concrete", "paving", "wet", "odd",
)  # fmt: skip
"""Looks of the ground; ``odd`` is a random pattern that no ground of the world has."""
PLANT_KINDS = ("grass", "reed", "fern", "cereal", "heath")


class Group:
    """A group of distributions, each a field."""

    def draw(self, random: np.random.Generator) -> SimpleNamespace:
        """A value for each distribution."""
        return SimpleNamespace(**{entry.name: getattr(self, entry.name).draw(random) for entry in fields(self)})  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class RouteSettings(Group):
    """The track that the driver follows.

    Attributes:
        radius: mean distance of the track from its middle [m].
        waviness: size of the higher harmonics of the closed curve [-].
        clockwise: direction of travel.
        slowest, fastest: range of commanded speeds as shares of the robot's maximum, at most 1.2 m/s [-].
        sway: amplitude of random yaw rates [rad/s].
    """

    radius: Uniform = Uniform(5.0, 11.5)
    waviness: Uniform = Uniform(0.05, 0.55)
    clockwise: Chance = Chance(0.5)
    slowest: Uniform = Uniform(0.15, 0.45)
    fastest: Uniform = Uniform(0.6, 1.0)
    sway: Uniform = Uniform(0.1, 0.6)


@dataclass(frozen=True, kw_only=True)
class TerrainShapeSettings(Group):
    """The shape of the ground.

    Attributes:
        hill_height: standard deviation of the hills [m].
        hill_size: wavelength-like scale of the hills [m].
        bumps: standard deviation of bumps of half a metre [m].
        roughness: standard deviation between neighbouring cells [m].
        slope: inclination of the whole world [rad].
        slope_direction: direction of ascent [rad].
        banks, ditches, steps, ramps, stairs: numbers of each; steps lead up or down.
        rim: height of the rise around the world [m].
        steepest: slopes along the track above this are flattened [rad].
    """

    hill_height: LogUniform = LogUniform(0.02, 0.45)
    hill_size: LogUniform = LogUniform(1.5, 7.0)
    bumps: LogUniform = LogUniform(0.005, 0.07)
    roughness: LogUniform = LogUniform(0.001, 0.015)
    slope: Uniform = Uniform(0.0, 12.0 * DEGREE)
    slope_direction: Uniform = Uniform(-math.pi, math.pi)
    banks: Whole = Whole(0, 3)
    ditches: Whole = Whole(0, 4)
    steps: Whole = Whole(0, 5)
    ramps: Whole = Whole(0, 3)
    stairs: Whole = Whole(0, 2)
    rim: Uniform = Uniform(0.0, 2.5)
    steepest: Uniform = Uniform(16.0 * DEGREE, 26.0 * DEGREE)


@dataclass(frozen=True, kw_only=True)
class VegetationSettings(Group):
    """Soft and firm vegetation.

    Attributes:
        any: whether the world has tall vegetation.
        coverage: share of the world under it [-].
        pattern: ``patches`` (ellipses), ``meadow`` (irregular) or ``bands``.
        extent: size of patches or irregularities [m].
        species: number of kinds of plants, each with its own look and firmness.
        kind: look of a species.
        height: [m].
        edge: width over which the height falls to zero [m].
        density: blades per area before the budget of triangles [1/m²].
        lift: upward force on each of four wheels at full depth [N]; wheels of the lightest robots carry 125 N, and what
            plants carry is lost for traction.
        drag, viscous_drag: resistance on a wheel in plants of full height [N], [N s/m].
        firm: whether a species hides a firm core that carries or stops a wheel.
        bushes: number of single bushes.
        bush_height: [m].
        bush_firm: whether a bush is firm, independent of its look.
        hidden_rocks: number of rocks inside the vegetation.
        hides_ditch: whether ditches are overgrown.
    """

    any: Chance = Chance(0.85)
    coverage: LogUniform = LogUniform(0.01, 0.6)
    pattern: Choice = Choice(("patches", "meadow", "bands"))
    extent: LogUniform = LogUniform(0.6, 4.5)
    species: Whole = Whole(1, 3)
    kind: Choice = Choice(PLANT_KINDS)
    height: Uniform = Uniform(0.1, 1.2)
    edge: LogUniform = LogUniform(0.1, 1.0)
    density: LogUniform = LogUniform(80.0, 700.0)
    lift: LogUniform = LogUniform(2.0, 55.0)
    drag: LogUniform = LogUniform(2.0, 40.0)
    viscous_drag: LogUniform = LogUniform(4.0, 80.0)
    firm: Chance = Chance(0.12)
    bushes: Whole = Whole(0, 12)
    bush_height: Uniform = Uniform(0.2, 1.4)
    bush_firm: Chance = Chance(0.5)
    hidden_rocks: Whole = Whole(0, 8)
    hides_ditch: Chance = Chance(0.3)


@dataclass(frozen=True, kw_only=True)
class ObstacleSettings(Group):
    """Things on the ground; every one has its own texture and colour.

    Attributes:
        boulders, stones, walls, kerbs, fences, posts, logs, trees, boxes, vehicles: numbers of each.
        clearance: free width beside the track [m].
        on_track: whether some obstacles stand on the track.
    """

    boulders: Whole = Whole(0, 24)
    stones: Whole = Whole(0, 45)
    walls: Whole = Whole(0, 7)
    kerbs: Whole = Whole(0, 4)
    fences: Whole = Whole(0, 3)
    posts: Whole = Whole(0, 12)
    logs: Whole = Whole(0, 6)
    trees: Whole = Whole(0, 36)
    boxes: Whole = Whole(0, 8)
    vehicles: Whole = Whole(0, 2)
    clearance: Uniform = Uniform(0.8, 2.0)
    on_track: Chance = Chance(0.3)


@dataclass(frozen=True, kw_only=True)
class GroundSettings(Group):
    """What the ground is made of.

    Attributes:
        kind: most of the ground.
        patches: number of patches of another kind.
        patch_kind: kind of each patch.
        patch_size: half-axis of a patch [m].
        path: whether a worn path follows the track.
        misleading: whether friction and softness are those of another kind than the look, drawn for each area.
    """

    kind: Choice = Choice(GROUND_KINDS, (4, 3, 2, 2, 2, 1, 2, 0.5, 1.5, 1.5, 1, 1, 1.5))
    patches: Whole = Whole(0, 9)
    patch_kind: Choice = Choice(GROUND_KINDS)
    patch_size: LogUniform = LogUniform(0.7, 3.5)
    path: Chance = Chance(0.4)
    misleading: Chance = Chance(0.25)


@dataclass(frozen=True, kw_only=True)
class LightSettings(Group):
    """Sun, sky and air.

    Attributes:
        sun_elevation, sun_azimuth: [rad].
        sun: brightness of the sun [-].
        ambient: brightness of the shade [-].
        warmth: colour of the sun from bluish (-1) to reddish (1).
        shadows: whether shadows are visible.
        cloudiness: share of the sky under clouds [-].
        sky: colours of the sky; ``odd`` is any colour.
        visibility: distance at which haze hides everything [m].
        season: colours of plants.
        horizon: height of the silhouettes on the horizon [rad].
    """

    sun_elevation: Uniform = Uniform(8.0 * DEGREE, 75.0 * DEGREE)
    sun_azimuth: Uniform = Uniform(-math.pi, math.pi)
    sun: Uniform = Uniform(0.25, 1.05)
    ambient: Uniform = Uniform(0.22, 0.6)
    warmth: Uniform = Uniform(-0.5, 1.0)
    shadows: Chance = Chance(0.7)
    cloudiness: Uniform = Uniform(0.0, 1.0)
    sky: Choice = Choice(("day", "overcast", "sunset", "dusk", "odd"), (4, 3, 1.5, 1, 0.7))
    visibility: LogUniform = LogUniform(14.0, 160.0)
    season: Choice = Choice(("spring", "summer", "autumn", "winter"))
    horizon: Uniform = Uniform(0.0, 8.0 * DEGREE)


@dataclass(frozen=True, kw_only=True)
class ImagingSettings(Group):
    """How a camera spoils its image.

    Attributes:
        exposure: compensation of the automatic exposure [EV].
        red, blue: white balance, factors on these channels [-].
        saturation, gamma: [-].
        noise: standard deviation in the middle greys [levels of 255].
        blur: standard deviation of the point spread [pixels].
        motion_blur: length of a streak [pixels].
        vignetting: loss of light in the corners [-].
        dirt: number of spots on the lens.
        quality: of the JPEG files, 1 to 100.
    """

    exposure: Uniform = Uniform(-0.9, 0.6)
    red: Uniform = Uniform(0.82, 1.2)
    blue: Uniform = Uniform(0.8, 1.22)
    saturation: Uniform = Uniform(0.45, 1.4)
    gamma: Uniform = Uniform(0.75, 1.3)
    noise: LogUniform = LogUniform(0.5, 10.0)
    blur: Uniform = Uniform(0.0, 1.3)
    motion_blur: Uniform = Uniform(0.0, 5.0)
    vignetting: Uniform = Uniform(0.0, 0.6)
    dirt: Whole = Whole(0, 7)
    quality: Whole = Whole(45, 95)


@dataclass(frozen=True, kw_only=True)
class RigSettings(Group):
    """The robot's cameras; each one is drawn separately.

    Attributes:
        count: number of cameras.
        size: WIDTHxHEIGHT [pixels].
        rate: images per second [Hz].
        portrait: whether a camera is mounted upright.
        height: above level ground [m].
        pitch: above the horizon; negative looks down [rad].
        roll: [rad].
        ahead: whether the first camera looks about ahead; else its yaw is as random as that of the others.
        yaw: [rad].
        field_of_view: along the longer side [rad].
        lens: distortion model.
        distortion: strength of the lens distortion [-].
        body: whether the camera is placed so that the robot's own body may be in view.
    """

    count: Choice = Choice(("1", "2", "3", "4", "5", "6"), (4, 1.5, 1, 1.5, 0.5, 1))
    size: Choice = Choice(("320x240", "320x180", "400x300", "320x256", "256x256"), (4, 1, 1, 1, 1))
    rate: Uniform = Uniform(10.0, 10.0)
    portrait: Chance = Chance(0.2)
    height: Uniform = Uniform(0.2, 1.5)
    pitch: Uniform = Uniform(-35.0 * DEGREE, 10.0 * DEGREE)
    roll: Uniform = Uniform(-4.0 * DEGREE, 4.0 * DEGREE)
    ahead: Chance = Chance(0.8)
    yaw: Uniform = Uniform(-math.pi, math.pi)
    field_of_view: Uniform = Uniform(45.0 * DEGREE, 150.0 * DEGREE)
    lens: Choice = Choice(("pinhole", "plumb_bob", "rational_polynomial", "equidistant"), (1.5, 3, 1, 2))
    distortion: Uniform = Uniform(0.2, 1.0)
    body: Chance = Chance(0.35)


@dataclass(frozen=True, kw_only=True)
class RobotSettings(Group):
    """The robot.

    Attributes:
        kind: a shipped robot file.
        hue, brightness: colour of its body [-].
    """

    kind: Choice = Choice(("husky", "warthog", "tradr", "marv"), (3, 1, 1.5, 1.5))
    hue: Uniform = Uniform(0.0, 1.0)
    brightness: Uniform = Uniform(0.1, 1.0)


@dataclass(frozen=True, kw_only=True)
class PaletteSettings(Group):
    """Colours and textures of things.

    Attributes:
        natural: share of things with the colours that they have in nature.
        shift: random change of natural colours [-].
        textures: share of surfaces with a random pattern instead of the one of their material.
    """

    natural: Uniform = Uniform(0.45, 1.0)
    shift: Uniform = Uniform(0.05, 0.35)
    textures: Uniform = Uniform(0.0, 0.6)


@dataclass(frozen=True, kw_only=True)
class WorldSettings:
    """Everything that is drawn for a world; groups are drawn from independent random streams."""

    style: str = "varied"
    route: RouteSettings = field(default_factory=RouteSettings)
    terrain: TerrainShapeSettings = field(default_factory=TerrainShapeSettings)
    vegetation: VegetationSettings = field(default_factory=VegetationSettings)
    obstacles: ObstacleSettings = field(default_factory=ObstacleSettings)
    ground: GroundSettings = field(default_factory=GroundSettings)
    light: LightSettings = field(default_factory=LightSettings)
    imaging: ImagingSettings = field(default_factory=ImagingSettings)
    rig: RigSettings = field(default_factory=RigSettings)
    robot: RobotSettings = field(default_factory=RobotSettings)
    palette: PaletteSettings = field(default_factory=PaletteSettings)

    @classmethod
    def of_style(cls, style: str) -> WorldSettings:
        """The settings of one of :data:`STYLES`."""
        if style not in STYLES:
            raise ValueError(f"style: got {style!r}, expected one of {', '.join(STYLES)}")
        return STYLES[style]

    def narrowed(self, assignments: Mapping[str, str]) -> WorldSettings:
        """The settings with single ones narrowed.

        Args:
            assignments: ``VALUE``, ``LOW..HIGH`` or names by ``GROUP.SETTING``, such as ``vegetation.height``.

        Raises:
            ValueError: there is no such setting, or the value is outside its range; the message names the setting.
        """
        settings = self
        for name, text in assignments.items():
            group_name, _, setting = name.partition(".")
            group = getattr(settings, group_name, None)
            if not isinstance(group, Group):
                raise ValueError(f"{name}: got group {group_name!r}, expected one of {', '.join(self.groups())}")
            known = [entry.name for entry in fields(group)]  # type: ignore[arg-type]
            if setting not in known:
                raise ValueError(f"{name}: got setting {setting!r}, expected one of {', '.join(known)}")
            try:
                narrowed = getattr(group, setting).narrowed(text)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
            changed: Any = {group_name: replace(cast("Any", group), **{setting: narrowed})}
            settings = replace(settings, **changed)
        return settings

    def groups(self) -> dict[str, Group]:
        """Every group by name."""
        found = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {name: group for name, group in found.items() if isinstance(group, Group)}

    def distributions(self) -> dict[str, Distribution]:
        """Every distribution by ``GROUP.SETTING``."""
        return {
            f"{name}.{entry.name}": getattr(group, entry.name)
            for name, group in self.groups().items()
            for entry in fields(group)  # type: ignore[arg-type]
        }


STYLES: dict[str, WorldSettings] = {
    "varied": WorldSettings(),
    # Every surface has a random pattern in random colours, so that only geometry and context are left to learn from.
    "textures": WorldSettings(
        style="textures",
        palette=PaletteSettings(natural=Uniform(0.0, 0.0), textures=Uniform(1.0, 1.0)),
        ground=GroundSettings(kind=Choice(("odd",)), patch_kind=Choice(("odd",))),
    ),
    # Yards, lawns and car parks: nearly level, with more walls and things, and less vegetation.
    "site": WorldSettings(
        style="site",
        terrain=TerrainShapeSettings(
            hill_height=LogUniform(0.005, 0.08),
            bumps=LogUniform(0.002, 0.02),
            roughness=LogUniform(0.0005, 0.005),
            slope=Uniform(0.0, 3.0 * DEGREE),
            banks=Whole(0, 1),
            ditches=Whole(0, 1),
            steps=Whole(0, 2),
            ramps=Whole(0, 1),
            stairs=Whole(0, 1),
            rim=Uniform(0.0, 0.3),
        ),
        vegetation=VegetationSettings(any=Chance(0.5), coverage=LogUniform(0.01, 0.2), hidden_rocks=Whole(0, 2)),
        obstacles=ObstacleSettings(
            boulders=Whole(0, 8),
            stones=Whole(0, 10),
            walls=Whole(2, 12),
            kerbs=Whole(0, 6),
            fences=Whole(0, 4),
            posts=Whole(2, 18),
            trees=Whole(0, 14),
            boxes=Whole(0, 12),
            vehicles=Whole(0, 3),
        ),
    ),
}
"""Settings by style. The style ``nature`` is the world of ``build_scenery``, whose seeds published tables rest on."""
