"""Plants: vegetation of a randomised world, whose look does not tell how firm it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter

from monoforce_ros.synthetic import shapes
from monoforce_ros.synthetic.obstacle import Obstacle, Part
from monoforce_ros.synthetic.route import Route
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.varied.ground_areas import GroundAreas
from monoforce_ros.synthetic.varied.relief import Relief
from monoforce_ros.synthetic.varied.settings import VegetationSettings
from monoforce_ros.synthetic.vegetation import Grass, GrassPatch, GrassSettings

_BLADES = 42_000
"""Budget of blades in a world: rendering takes as long as that of the worlds of style ``nature``."""
_REACH = 8.0
"""Plants grow within this distance of the track [m]; cameras hardly see those farther away."""
_START_RADIUS = 0.8
_TILE = 5.0
_CORE_HEIGHT = 0.75
"""Height of a firm core relative to the plants around it: they hide it."""
_FULL = 0.05


def _no_cells() -> np.ndarray:
    return np.zeros((0, 0))


@dataclass(frozen=True)
class Species:
    """A kind of plant in one world.

    Attributes:
        kind: geometry, one of ``settings.PLANT_KINDS``.
        material: name of its palette.
        height: [m].
        density: blades per area [1/m²].
        lift: upward force on each of four wheels at full depth [N].
        drag, viscous_drag: see :class:`monoforce_ros.synthetic.vegetation.GrassSettings`.
        is_firm: it hides a core that stops wheels.
    """

    kind: str
    material: str
    height: float
    density: float
    lift: float
    drag: float
    viscous_drag: float
    is_firm: bool


@dataclass(frozen=True)
class MixedGrass(Grass):
    """Plants of several species and soft layers of ground, as one field of forces.

    Attributes:
        full_height: height of the plants or thickness of the layer at each cell of the canopy's grid [m].
        lift, drag, viscous_drag: forces on a wheel at full depth, at each cell; see :class:`Species`.
    """

    full_height: np.ndarray = field(default_factory=_no_cells)
    lift: np.ndarray = field(default_factory=_no_cells)
    drag: np.ndarray = field(default_factory=_no_cells)
    viscous_drag: np.ndarray = field(default_factory=_no_cells)

    def wheel_forces(
        self, ground: HeightField, centres: np.ndarray, radii: np.ndarray, velocities: np.ndarray, share: float = 1.0
    ) -> np.ndarray | None:
        """Forces on wheels; see :meth:`monoforce_ros.synthetic.vegetation.Grass.wheel_forces`."""
        position = np.nan_to_num((centres[:, :2] - ground.origin) / ground.resolution)
        column, row = np.clip(np.rint(position).astype(int), 0, len(self.full_height) - 1).T
        full = self.full_height[row, column]
        if not full.any():
            return None
        soft = self.height_at(centres[:, :2])
        if self.layer is not None:
            soft = soft + self.layer.height_at(centres[:, :2])
        depth = np.clip(ground.height_at(centres[:, :2]) + soft - (centres[:, 2] - radii), 0.0, soft)
        speed = np.linalg.norm(velocities[:, :2], axis=1)
        resistance = self.drag[row, column] * np.tanh(speed / 0.05) + self.viscous_drag[row, column] * speed
        share_of_depth = np.minimum(depth / np.maximum(full, _FULL), 1.0)
        resistance *= share_of_depth
        forces = np.zeros((len(centres), 3))
        forces[:, :2] = -(resistance / np.maximum(speed, 1e-6))[:, None] * velocities[:, :2]
        forces[:, 2] = self.lift[row, column] * share_of_depth
        return share * forces


@dataclass(frozen=True)
class Vegetation:
    """Everything that grows.

    Attributes:
        grass: canopy and forces.
        cores: height of the cores of firm species above the ground [m], on the ground's grid; None without any.
        foliage: meshes of blades, leaves and cores of bushes, as obstacles of kind ``plants`` and ``bush``.
        materials: kind of plant by name of palette.
        coverage: share of the world under tall vegetation [-].
        height: mean nominal height of its species [m], 0 without any.
        hidden_places: ``[n, 2]`` positions inside vegetation where rocks may hide [m].
    """

    grass: MixedGrass
    cores: HeightField | None
    foliage: tuple[Obstacle, ...]
    materials: dict[str, str]
    coverage: float
    height: float
    hidden_places: np.ndarray


def draw_vegetation(
    settings: VegetationSettings, relief: Relief, areas: GroundAreas, route: Route, random: np.random.Generator
) -> Vegetation:
    """Grow plants anywhere, independent of the route (but for the budget of blades far from it)."""
    drawn, ground = settings.draw(random), relief.ground
    x, y = ground.grid()
    from_start = np.hypot(x, y)
    near = route.distance(np.stack([x, y], axis=-1))
    species = [_draw_species(settings, index, random) for index in range(drawn.species)]
    inside, which = np.zeros(x.shape), np.zeros(x.shape, int)
    if drawn.any:
        mask = _pattern(drawn.pattern, drawn.coverage, drawn.extent, ground, random)
        if drawn.hides_ditch:
            mask |= binary_dilation(relief.ditches, iterations=4)
        mask &= (from_start > _START_RADIUS) & (near < _REACH)
        inside = np.clip(distance_transform_edt(mask) * ground.resolution / drawn.edge, 0.0, 1.0)
        fields = [gaussian_filter(random.standard_normal(x.shape), 1.5 / ground.resolution) for _ in species]
        which = np.argmax(fields, axis=0)
    heights = np.array([kind.height for kind in species])[which] * inside
    uneven = gaussian_filter(random.standard_normal(x.shape), 0.35 / ground.resolution)
    heights *= np.clip(1.0 + random.uniform(0.05, 0.2) * uneven / uneven.std(), 0.3, 1.6)
    foliage: list[Obstacle] = []
    if drawn.any:
        foliage += grow_blades(species, which, heights, ground, random)
    firm = np.array([kind.is_firm for kind in species])[which] & (inside > 0.6)
    cores = np.where(firm, _CORE_HEIGHT * heights, 0.0)
    values = {
        name: np.array([getattr(kind, name) for kind in species])[which] for name in ("lift", "drag", "viscous_drag")
    }
    full = np.where(heights > 0.0, np.array([kind.height for kind in species])[which], 0.0)
    for number in range(drawn.bushes):
        # Anywhere in the world but at the start.
        centre = ground.centre + random.uniform(-1.0, 1.0, 2) * (ground.half_size - 4.0)
        height = settings.bush_height.draw(random)
        is_firm = settings.bush_firm.draw(random)
        radius = height * random.uniform(0.45, 0.9)
        soft = {"lift": settings.lift, "drag": settings.drag, "viscous_drag": settings.viscous_drag}
        strengths = {name: distribution.draw(random) for name, distribution in soft.items()}
        bush = _bush(number % 3, centre, radius, height, is_firm, ground, random)
        if np.linalg.norm(centre) < 1.3 + radius or (is_firm and route.distance(centre) < 0.7 + radius):
            continue
        foliage.append(bush)
        if not is_firm:
            cells = np.clip(1.3 * (1.0 - np.hypot(x - centre[0], y - centre[1]) / radius), 0.0, 1.0) > 0.0
            dome = height * np.sqrt(np.clip(1.0 - ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / radius**2, 0.0, 1.0))
            heights = np.maximum(heights, dome)
            full[cells] = height
            for name, strength in strengths.items():
                values[name][cells] = strength
    # Soft ground below and between the plants.
    layer = areas.depth
    open_ground = (full == 0.0) & (layer > 0.0)
    for name in values:
        values[name] = np.where(open_ground, areas.values(name), values[name])
    full = np.where(open_ground, np.maximum(areas.values("depth"), 0.01), full)
    make = lambda heights: HeightField(heights, ground.resolution, ground.origin)  # noqa: E731
    grass = MixedGrass(
        GrassSettings(), make(heights), (), make(layer) if layer.any() else None, full, values["lift"],
        values["drag"], values["viscous_drag"],
    )  # fmt: skip
    materials = {kind.material: kind.kind for kind in species} | {f"bush_{index}": "bush" for index in range(3)}
    tall = heights > 0.05
    places = np.argwhere((inside > 0.8) & (heights > 0.2) & (from_start > 2.0))
    chosen = random.permutation(len(places))[: drawn.hidden_rocks]
    hidden = ground.origin + ground.resolution * places[chosen][:, ::-1]
    mean_height = float(np.mean([kind.height for kind in species])) if tall.any() and drawn.any else 0.0
    return Vegetation(
        grass, make(cores) if cores.any() else None, tuple(foliage), materials, float(tall.mean()), mean_height, hidden
    )


def _draw_species(settings: VegetationSettings, index: int, random: np.random.Generator) -> Species:
    return Species(
        settings.kind.draw(random), f"plants_{index}", settings.height.draw(random), settings.density.draw(random),
        settings.lift.draw(random), settings.drag.draw(random), settings.viscous_drag.draw(random),
        settings.firm.draw(random),
    )  # fmt: skip


def _pattern(name: str, coverage: float, extent: float, ground: HeightField, random: np.random.Generator) -> np.ndarray:
    """Mask of the ground's grid with a share ``coverage`` set."""
    x, y = ground.grid()
    if name == "patches":
        mask = np.zeros(x.shape, bool)
        ragged = gaussian_filter(random.standard_normal(x.shape), 0.25 / ground.resolution)
        ragged *= 0.16 / ragged.std()
        for _ in range(400):
            if mask.mean() >= coverage:
                break
            centre = ground.centre + random.uniform(-1.0, 1.0, 2) * ground.half_size
            size = extent * random.uniform(0.4, 1.4, 2)
            patch = GrassPatch(centre, random.uniform(-math.pi, math.pi), *size)
            mask |= patch.edge_distance(x, y) + ragged > 0.0
        return mask
    level = gaussian_filter(random.standard_normal(x.shape), 0.5 * extent / ground.resolution, mode="wrap")
    level /= level.std()
    if name == "bands":
        heading = random.uniform(-math.pi, math.pi)
        along = np.cos(heading) * x + np.sin(heading) * y
        wavelength = extent * random.uniform(2.0, 4.0)
        level = np.sin(2.0 * math.pi * along / wavelength + 0.8 * level + random.uniform(0.0, 6.3))
    return level > np.quantile(level, 1.0 - coverage)


def grow_blades(
    species: list[Species],
    which: np.ndarray,
    heights: np.ndarray,
    ground: HeightField,
    random: np.random.Generator,
) -> list[Obstacle]:
    """Blades in tiles, so that a camera can skip those out of view.

    Args:
        species: kinds of plants.
        which: index of the species at each cell of the ground's grid.
        heights: of the plants at each cell [m].
        ground: what they grow on.
        random: generator of positions and shapes.
    """
    cells = np.argwhere(heights > 0.06)
    if not len(cells):
        return []
    density = np.array([kind.density for kind in species])[which[cells[:, 0], cells[:, 1]]]
    # Taller plants are as wide as they need to be to hide the ground with the blades that the budget allows.
    wanted = density.sum() * ground.resolution**2
    count = int(min(wanted, _BLADES))
    widening = math.sqrt(wanted / max(count, 1))
    chosen = cells[random.choice(len(cells), count, p=density / density.sum())]
    positions = ground.origin + ground.resolution * (chosen[:, ::-1] + random.uniform(-0.5, 0.5, (count, 2)))
    positions = np.clip(positions, ground.origin, ground.origin + 2 * ground.half_size)
    tops = heights[chosen[:, 0], chosen[:, 1]] * random.uniform(0.6, 1.15, count)
    kinds = which[chosen[:, 0], chosen[:, 1]]
    roots = np.concatenate([positions, ground.height_at(positions)[:, None] - 0.01], axis=1)
    wind = random.uniform(-0.35, 0.35, 2)
    tile = np.floor((positions - ground.origin) / _TILE).astype(int)
    found = []
    for index, kind in enumerate(species):
        for corner in np.unique(tile[kinds == index], axis=0):
            part = (kinds == index) & (tile == corner).all(axis=1)
            mesh = _plant_mesh(kind.kind, roots[part], tops[part], widening, wind, random)
            middle = ground.origin + _TILE * (corner + 0.5)
            found.append(Obstacle("plants", (Part(mesh, kind.material, is_solid=False),), middle, _TILE))
    return found


def _plant_mesh(
    kind: str, roots: np.ndarray, tops: np.ndarray, widening: float, wind: np.ndarray, random: np.random.Generator
) -> shapes.Shape:
    width = {"grass": 0.016, "reed": 0.03, "cereal": 0.011, "fern": 0.09, "heath": 0.07}[kind] * widening
    spread = {"grass": 0.25, "reed": 0.07, "cereal": 0.1, "fern": 0.7, "heath": 0.35}[kind]
    lean = wind * spread / 0.35 + spread * random.standard_normal((len(roots), 2))
    if kind == "heath":
        return shapes.twigs(roots, tops, min(width, 0.14), lean, random)
    return shapes.blades(roots, tops, min(width, 0.2), lean, random)


def _bush(
    look: int,
    centre: np.ndarray,
    radius: float,
    height: float,
    is_firm: bool,
    ground: HeightField,
    random: np.random.Generator,
) -> Obstacle:
    base = np.array([*centre, float(ground.height_at(centre))])
    leaves = shapes.bush(radius, height, 420, random).moved(base)
    parts = [Part(leaves, f"bush_{look}", is_solid=False)]
    if is_firm:
        core = shapes.trunk(0.75 * radius, 0.8 * height + 0.1).moved(base - np.array([0.0, 0.0, 0.1]))
        parts.append(Part(core, "", is_visible=False))
    return Obstacle("bush", tuple(parts), centre, radius)
