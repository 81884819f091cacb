"""World: scenery and vehicle as one MuJoCo model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.synthetic import textures, vehicle
from monoforce_ros.synthetic.fault import Fault
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.paint import Light, Paint
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.shapes import Shape
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.vegetation import short_grass
from monoforce_ros.synthetic.vehicle import Vehicle

TIME_STEP = 0.002

# Geometry groups, which select what rays and cameras see.
SOLID_GROUP = 0
DRAWN_GROUND_GROUP = 1
GRASS_GROUP = 2
COLLISION_GROUND_GROUP = 3
RAY_GROUND_GROUP = 4
ROBOT_GROUP = vehicle.GROUP
RAY_GROUPS = (SOLID_GROUP, GRASS_GROUP, RAY_GROUND_GROUP)
DRAWN_GROUPS = (SOLID_GROUP, DRAWN_GROUND_GROUP, GRASS_GROUP, ROBOT_GROUP)

_SPAWN_HEIGHT = 0.05
# The rendered ground is coarser than the collision ground by this factor, to save triangles.
_DRAWN_STEP = 2
_TILE_SIZE = 5.0
_WIDE_LENS_NEAR = 0.015


def build_model(
    scenery: Scenery, robot: Vehicle, seed: int, cameras: Mapping[str, float], hidden: Sequence[Fault] = ()
) -> mujoco.MjModel:
    """Compile a world.

    The ground is modelled three times: as a height field for contacts, as a mesh for rays (forty times faster than a
    height field), and as a coarser textured mesh for cameras.

    Args:
        scenery: ground, rocks, trees and grass.
        robot: placed at the origin, heading along x.
        seed: seed of the colours.
        cameras: vertical field of view [rad] by sensor frame; if empty, geometry for images is left out.
        hidden: faults to inject.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = TIME_STEP
    spec.compiler.degree = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    _add_ground(spec, scenery)
    materials: set[str] = set()
    if cameras:
        look = scenery.appearance
        paint = textures.nature(scenery, seed) if look is None else look.paint(scenery)
        materials = _add_materials(spec, paint)
        _add_drawn_ground(spec, scenery, paint.turf, random_stream(seed, "short grass"))
        _add_light(spec, paint.light)
        if look is not None:
            # The corner of a fisheye image close above the ground sees points of little depth.
            spec.visual.map.znear = _WIDE_LENS_NEAR
        if paint.surroundings is not None:
            _add_surroundings(spec, scenery.ground, paint.surroundings)
    for index, rock in enumerate(scenery.rocks):
        _add_shape(spec, f"rock_{index}", rock, "rock", materials, SOLID_GROUP, solid=True)
    for index, wall in enumerate(scenery.walls):
        _add_shape(spec, f"wall_{index}", wall.shape, "wall", materials, SOLID_GROUP, solid=True)
    for index, tree in enumerate(scenery.trees):
        _add_shape(spec, f"trunk_{index}", tree.stem, "bark", materials, SOLID_GROUP, solid=True)
        _add_shape(spec, f"crown_{index}", tree.crown, tree.foliage, materials, SOLID_GROUP, solid=False)
    for index, tile in enumerate(scenery.grass.tiles):
        _add_shape(spec, f"grass_{index}", tile, "grass", materials, GRASS_GROUP, solid=False)
    for index, obstacle in enumerate(scenery.obstacles):
        for number, part in enumerate(obstacle.parts):
            # What neither cameras nor rays see belongs to the group of the collision ground.
            visible_group = SOLID_GROUP if part.is_solid else GRASS_GROUP
            group = visible_group if part.is_visible else COLLISION_GROUND_GROUP
            name = f"{obstacle.kind}_{index}_{number}"
            _add_shape(spec, name, part.shape, part.material, materials, group, solid=part.is_solid)
    robot.add_to(spec, robot.clearance + _SPAWN_HEIGHT)
    for frame, field_of_view in cameras.items():
        _add_camera(spec, frame, robot.sensors[frame], field_of_view)
    for fault in hidden:
        fault.modify_spec(spec, robot)
    return spec.compile()


def _add_camera(spec: mujoco.MjSpec, frame: str, pose: np.ndarray, field_of_view: float) -> None:
    # An optical frame looks along z with y down, a MuJoCo camera along -z with y up.
    flipped = Rotation.from_matrix(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
    scalar_first = np.roll(flipped.as_quat(), 1)
    spec.body(vehicle.BODY).add_camera(name=frame, pos=pose[:3, 3], quat=scalar_first, fovy=math.degrees(field_of_view))


def _add_ground(spec: mujoco.MjSpec, scenery: Scenery) -> None:
    ground = scenery.support
    lowest = float(ground.heights.min())
    # MuJoCo divides by the range of heights, which is zero for level ground.
    span = max(float(np.ptp(ground.heights)), 1e-3)
    spec.add_hfield(
        name="ground",
        size=[ground.half_size, ground.half_size, span, 1.0],
        nrow=ground.heights.shape[0],
        ncol=ground.heights.shape[1],
        userdata=((ground.heights - lowest) / span).ravel(),
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        pos=[*ground.centre, lowest],
        group=COLLISION_GROUND_GROUP,
        contype=1,
        conaffinity=2,
    )
    vertices, faces = scenery.surface.triangles()
    spec.add_mesh(
        name="ray_ground",
        uservert=vertices.ravel(),
        userface=faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ray_ground", group=RAY_GROUND_GROUP, contype=0, conaffinity=0
    )


def _add_drawn_ground(
    spec: mujoco.MjSpec, scenery: Scenery, turf_cover: np.ndarray, random: np.random.Generator
) -> None:
    """Add the ground for images in tiles, so that a camera can skip those out of view."""
    ground = scenery.surface
    count = ground.heights.shape[0]
    tile = _DRAWN_STEP * round(_TILE_SIZE / ground.resolution / _DRAWN_STEP)
    normals = ground.normals()
    for row in range(0, count - 1, tile):
        for column in range(0, count - 1, tile):
            window = np.s_[row : row + tile + 1, column : column + tile + 1]
            origin = ground.origin + ground.resolution * np.array([column, row])
            part = HeightField(ground.heights[window], ground.resolution, origin)
            vertices, faces = part.triangles(_DRAWN_STEP)
            coordinates = (vertices[:, :2] - ground.origin) / (2 * ground.half_size)
            shading = normals[window][::_DRAWN_STEP, ::_DRAWN_STEP].reshape(-1, 3)
            name = f"drawn_ground_{row}_{column}"
            shape = Shape(vertices, faces, shading, coordinates)
            _add_shape(spec, name, shape, "ground", {"ground"}, DRAWN_GROUND_GROUP, solid=False)
            turf = short_grass(ground, scenery.route, turf_cover, part, random)
            _add_shape(spec, f"turf_{row}_{column}", turf, "grass", {"grass"}, DRAWN_GROUND_GROUP, solid=False)


def _add_shape(
    spec: mujoco.MjSpec, name: str, shape: Shape, material: str, materials: set[str], group: int, *, solid: bool
) -> None:
    if not len(shape.faces):
        return
    spec.add_mesh(
        name=name,
        uservert=shape.vertices.ravel(),
        userface=shape.faces.ravel(),
        usernormal=shape.normals.ravel(),
        userfacenormal=shape.faces.ravel(),
        usertexcoord=shape.texture_coordinates.ravel(),
        userfacetexcoord=shape.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX if solid else mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    bits = {"contype": 1, "conaffinity": 2} if solid else {"contype": 0, "conaffinity": 0}
    geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=group, **bits)
    if material in materials:
        geom.material = material


def _add_materials(spec: mujoco.MjSpec, paint: Paint) -> set[str]:
    for name, image in paint.materials.items():
        texture = spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=image.shape[1],
            height=image.shape[0],
            nchannel=3,
        )
        texture.data = image.tobytes()
        material = spec.add_material(name=name, specular=0.0, shininess=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    texture = spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        width=paint.sky.shape[1],
        height=paint.sky.shape[0],
        nchannel=3,
    )
    texture.data = paint.sky.tobytes()
    return set(paint.materials)


def _add_surroundings(spec: mujoco.MjSpec, ground: HeightField, colour: tuple[float, float, float]) -> None:
    """Add a plane that the world lies on, so that its edge does not end in the sky."""
    position = [*ground.centre, float(ground.heights.min()) - 0.05]
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, pos=position, size=[200.0, 200.0, 1.0],
        rgba=[*colour, 1.0], group=DRAWN_GROUND_GROUP, contype=0, conaffinity=0,
    )  # fmt: skip


def _add_light(spec: mujoco.MjSpec, light: Light) -> None:
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=-light.to_sun,
        pos=20.0 * light.to_sun,
        diffuse=light.sun,
        specular=[0.0, 0.0, 0.0],
        castshadow=False,
    )
    spec.visual.headlight.ambient = light.ambient
    spec.visual.headlight.diffuse = [0.06, 0.06, 0.06]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    # Cameras oversample instead, which smooths edges at a third of the cost.
    spec.visual.quality.offsamples = 0
    spec.visual.rgba.fog = [*light.haze, 1.0]
    spec.stat.extent = 1.0
    spec.visual.map.fogstart = light.haze_start
    spec.visual.map.fogend = light.haze_end
    spec.visual.map.znear = 0.05
    spec.visual.map.zfar = max(90.0, 1.1 * light.haze_end)
