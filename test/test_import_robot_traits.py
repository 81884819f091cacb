"""What published robot descriptions have in common, each in a small description of our own."""

import shutil

import numpy as np
import pytest

from monoforce_ros.importing import draw_robot
from monoforce_ros.importing.cli import main, robot_file_text
from monoforce_ros.robots import ConversionOptions, UrdfError, convert_description, load_robot, read_description
from monoforce_ros.robots.belt import belt_outline

BOX = '<collision><origin xyz="{place}"/><geometry><box size="{size}"/></geometry></collision>'
INERTIAL = '<inertial><mass value="{mass}"/><inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial>'


def link(name, *shapes, mass=0.0, inertia=None):
    body = INERTIAL.format(mass=mass, i=0.02 * mass if inertia is None else inertia) if mass else ""
    return f'<link name="{name}">{body}{"".join(shapes)}</link>'


def box(size, place="0 0 0"):
    return BOX.format(size=size, place=place)


def round_shape(shape, rpy="0 0 0"):
    return f'<collision><origin rpy="{rpy}"/><geometry><{shape}/></geometry></collision>'


def mesh(uri):
    return f'<collision><geometry><mesh filename="{uri}"/></geometry></collision>'


def joint(name, kind, parent, child, place="0 0 0", axis="0 1 0", extra="", rpy="0 0 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}" rpy="{rpy}"/><axis xyz="{axis}"/>{extra}</joint>'
    )


def wheel(name, place, parent="base_link", radius=0.1, width=0.04, axis="0 1 0", rpy="1.5707963 0 0", extra=""):
    shape = round_shape(f'cylinder radius="{radius}" length="{width}"', rpy)
    return link(f"{name}_link", shape, mass=0.5, inertia=0.003) + joint(
        name, "continuous", parent, f"{name}_link", place, axis, extra
    )


def robot(tmp_path, *parts, name="robot.urdf"):
    path = tmp_path / name
    path.write_text(f'<robot name="robot">{"".join(parts)}</robot>')
    return path


def convert(path, ignore_meshes=False, **options):
    return convert_description(read_description(path, ignore_meshes=ignore_meshes), ConversionOptions(**options))


def imported(path, tmp_path, *arguments):
    """Exit status of the command, and the robot."""
    out = tmp_path / "out.yaml"
    status = main([str(path), "--out", str(out), "--no-picture", "--force", *arguments])
    return status, load_robot(out)


def small_robot(*parts):
    """Two wheels on one axle, with the given parts."""
    return (
        link("base_link", box("0.3 0.2 0.06", "0 0 0.05"), mass=4.0),
        wheel("left_wheel", "0 0.15 0"),
        wheel("right_wheel", "0 -0.15 0"),
        *parts,
    )


def test_a_ball_that_is_fixed_to_the_body_rolls_as_a_caster(tmp_path):
    balls = [
        part
        for end, place in (("front", "0.12 0 -0.07"), ("rear", "-0.12 0 -0.07"))
        for part in (
            link(f"{end}_ball", round_shape('sphere radius="0.03"'), mass=0.05),
            joint(f"{end}_ball_joint", "fixed", "base_link", f"{end}_ball", place),
        )
    ]
    path = robot(tmp_path, *small_robot(*balls))
    found = convert(path)
    assert found.content["drive"]["kind"] == "differential" and not found.warnings
    assert [entry["wheel"] for entry in found.content["casters"]] == ["front_ball", "rear_ball"]
    front = next(entry for entry in found.content["wheels"] if entry["name"] == "front_ball")
    assert front["drive"] is None and front["radius"] == pytest.approx(0.03)
    np.testing.assert_allclose(front["centre"], [0.12, 0.0, -0.07], atol=1e-5)
    assert [entry["name"] for entry in found.content["hull"]] == ["base_link"]
    # As boxes of the hull they held the robot: it stood still at every command.
    assert imported(path, tmp_path)[0] == 0
    left_out = convert(path, hints={"front_ball": "fixed"})
    assert [entry["wheel"] for entry in left_out.content["casters"]] == ["rear_ball"]


def test_a_box_named_caster_or_hinted_so_is_a_caster_and_other_parts_are_not(tmp_path):
    for name, hints, casters in (("caster_back", {}, 1), ("skid_pad", {}, 0), ("skid_pad", {"skid_pad": "caster"}, 1)):
        path = robot(
            tmp_path,
            *small_robot(
                link(name, box("0.03 0.02 0.01"), mass=0.01), joint("pad", "fixed", "base_link", name, "-0.12 0 -0.095")
            ),
        )
        found = convert(path, hints=hints)
        assert len(found.content.get("casters", [])) == casters
        assert found.content["drive"]["kind"] == "differential"
        assert any("stand on one axle" in warning for warning in found.warnings) == (casters == 0)
    # The contact stays where it is, and is not smaller than a robot file allows.
    support = next(entry for entry in found.content["wheels"] if entry["name"] == "skid_pad")
    assert support["centre"][2] - support["radius"] == pytest.approx(-0.1) and support["radius"] >= 0.01


def test_casters_of_a_robot_of_one_kilogram_can_be_loaded(tmp_path):
    path = robot(
        tmp_path,
        link("base_link", box("0.14 0.14 0.1", "-0.03 0 0.07"), mass=0.9, inertia=0.002),
        wheel("left_wheel", "0 0.08 0.023", radius=0.033, width=0.018),
        wheel("right_wheel", "0 -0.08 0.023", radius=0.033, width=0.018),
        link("caster", box("0.03 0.02 0.009"), mass=0.005),
        joint("caster_joint", "fixed", "base_link", "caster", "-0.08 0 -0.005"),
    )
    status, loaded = imported(path, tmp_path)
    assert loaded.joint_names == ("caster_joint",) and status in (0, 1)


def test_small_wheels_are_round():
    outline = belt_outline(0.0, 0.03, 0.03, 0.06)[0]
    assert len(outline) >= 12 and outline[:, 1].min() < -0.96 * 0.03
    # Larger ones keep their spacing.
    assert len(belt_outline(0.0, 0.3, 0.3, 0.06)[0]) == 32


def car_along_y(tmp_path):
    """A car whose frame has y backwards: wheels turn about x, the steered ones lie at negative y."""
    limit = '<limit lower="-0.6" upper="0.6" effort="1" velocity="1000"/>'
    parts = [link("body", box("0.5 1.2 0.3", "0 0 0.3"), mass=60.0)]
    for side, x in (("left", 0.35), ("right", -0.35)):
        parts += [
            link(f"{side}_knuckle", mass=0.5),
            joint(f"{side}_steer", "continuous", "body", f"{side}_knuckle", f"{x} -0.5 0.15", "0 0 1", limit),
            wheel(f"front_{side}_wheel", "0 0 0", f"{side}_knuckle", 0.15, 0.1, "1 0 0", "0 1.5707963 0"),
            wheel(f"rear_{side}_wheel", f"{x} 0.5 0.15", "body", 0.15, 0.1, "1 0 0", "0 1.5707963 0"),
        ]
    return robot(tmp_path, *parts)


def test_a_frame_with_another_direction_of_travel(tmp_path):
    path = car_along_y(tmp_path)
    with pytest.raises(UrdfError, match=r"drove sideways.*axes of body \(--forward=y or --forward=-y\)"):
        convert(path)
    found = convert(path, forward="-y")
    front = next(entry for entry in found.content["wheels"] if entry["name"] == "front_left")
    assert front["centre"] == pytest.approx([0.5, 0.35, 0.15]) and found.content["drive"]["kind"] == "ackermann"
    assert found.content["base_frame"] == "body_forward"
    assert "--yaw -1.570796 --frame-id body --child-frame-id body_forward" in found.warnings[0]
    np.testing.assert_allclose(found.content["hull"][0]["size"], [1.2, 0.5, 0.3])
    assert imported(path, tmp_path, "--forward=-y")[0] == 0
    with pytest.raises(UrdfError, match="expected one of x, y, -x, -y"):
        convert(path, forward="north")
    turned = robot(tmp_path, *small_robot())
    with pytest.raises(UrdfError, match=r"--forward=x or --forward=-x"):
        convert(turned, forward="y")


def test_front_wheel_drive_by_hint(tmp_path):
    path = car_along_y(tmp_path)
    drives = {entry["name"]: entry["drive"] for entry in convert(path, forward="-y").content["wheels"]}
    assert drives["front_left"] is None and drives["rear_left"] == "rear"
    hints = {"front_left_wheel": "wheel", "front_right_wheel": "wheel"}
    drives = {entry["name"]: entry["drive"] for entry in convert(path, forward="-y", hints=hints).content["wheels"]}
    assert drives["front_left"] == "front" and drives["rear_left"] is None


def on_rockers(tmp_path, mass_ahead="0.04"):
    parts = [link("base_link", box("0.8 0.4 0.2", f"{mass_ahead} 0 0.1"), mass=60.0)]
    limit = '<limit lower="-0.15" upper="0.15" effort="1" velocity="1"/>'
    for side, y in (("left", 0.3), ("right", -0.3)):
        parts += [
            link(f"{side}_rocker", mass=5.0),
            joint(f"{side}_rocker_jnt", "revolute", "base_link", f"{side}_rocker", f"0.04 {y} -0.05", extra=limit),
            *(
                wheel(f"{end}_{side}_wheel_jnt", f"{x} 0 0", f"{side}_rocker", 0.2)
                for end, x in (("f", 0.3), ("r", -0.3))
            ),
        ]
    return robot(tmp_path, *parts)


def test_a_body_that_hangs_on_one_axis_does_not_tip_onto_its_stops(tmp_path):
    path = on_rockers(tmp_path)
    found = convert(path)
    assert "rockers" not in found.content
    assert any("left_rocker_jnt, right_rocker_jnt: held at 0" in guess for guess in found.guesses)
    assert {entry["name"] for entry in found.content["wheels"]} == {"f_left", "r_left", "f_right", "r_right"}
    assert imported(path, tmp_path)[0] == 0
    swinging = convert(path, hints={"left_rocker_jnt": "rocker"})
    assert [entry["name"] for entry in swinging.content["rockers"]] == ["left_rocker_jnt", "right_rocker_jnt"]


def crawler(tmp_path):
    """Tracks are shapes of the body's link, one joint turns the flippers of both sides."""
    sides = [box("1.0 0.12 0.3", f"0 {y} 0") for y in (0.25, -0.25)]
    flippers = [box("0.5 0.1 0.2", f"0.2 {y} -0.05") for y in (0.4, -0.4)]
    limit = '<limit lower="-0.5" upper="0.9" effort="100" velocity="1.5"/>'
    return robot(
        tmp_path,
        link("base_link", box("0.9 0.3 0.2", "0 0 0.1"), *sides, mass=40.0),
        link("flipper_link", *flippers, mass=6.0, inertia=0.2),
        joint("flipper_front", "revolute", "base_link", "flipper_link", "0.4 0 0", "0 -1 0", limit),
    )


def test_tracks_and_flippers_of_both_sides_in_one_link(tmp_path):
    path = crawler(tmp_path)
    found = convert(path)
    assert any("only flippers touch the ground" in warning and "--track LINK" in warning for warning in found.warnings)
    found = convert(path, hints={"base_link": "track"})
    tracks = {entry["name"]: entry for entry in found.content["tracks"]}
    assert set(tracks) == {"base_link_left", "base_link_right"}
    assert tracks["base_link_left"]["centre"] == pytest.approx([0.0, 0.25, 0.0])
    assert tracks["base_link_left"]["length"] == pytest.approx(0.7) and tracks["base_link_left"]["drive"] == "left"
    assert len(found.content["hull"]) == 1 and found.content["command"]["track_width"] == pytest.approx(0.5)
    flippers = {entry["name"]: entry for entry in found.content["flippers"]}
    assert set(flippers) == {"flipper_front_left", "flipper_front_right"}
    left = flippers["flipper_front_left"]
    # The belt is as high as the box, though the axle is not in its middle.
    assert left["mass"] == pytest.approx(3.0) and left["tip_radius"] == pytest.approx(0.1)
    assert left["length"] == pytest.approx(np.hypot(0.35, 0.05), abs=1e-5) and left["angle"] == pytest.approx(
        np.arctan2(-0.05, 0.35)
    )
    assert imported(path, tmp_path, "--track", "base_link")[0] == 0


def test_names_of_flippers_are_those_of_their_joints_and_other_signs_are_reported(tmp_path):
    parts = [link("base_link", box("0.6 0.3 0.2"), mass=20.0)]
    for side, y in (("l", 0.25), ("r", -0.25)):
        parts += [
            link(f"track_{side}", box("0.6 0.1 0.2"), mass=2.0),
            joint(f"track_{side}_j", "fixed", "base_link", f"track_{side}", f"0 {y} 0"),
            link(f"flipper_f{side}", box("0.3 0.06 0.1", "0.1 0 0"), mass=1.0),
            joint(f"flipper_f{side}_j", "continuous", "base_link", f"flipper_f{side}", f"0.25 {1.5 * y} 0", "0 1 0"),
        ]
    found = convert(robot(tmp_path, *parts))
    assert [entry["name"] for entry in found.content["flippers"]] == ["flipper_fl_j", "flipper_fr_j"]
    assert any("flipper_fl_j: its angle in the robot file is +0 - the joint's" in text for text in found.warnings)


def test_parts_without_their_meshes_are_reported(tmp_path):
    wheels = [
        link("wheel_link", mesh("package://bot/wheel.stl"), mass=1.0),
        joint("wheel_joint", "continuous", "base_link", "wheel_link", "0.2 0.2 0"),
    ]
    body = [link("base_link", mesh("file:///nowhere/body.stl"), mass=10.0)]
    path = robot(tmp_path, *body, *wheels)
    with pytest.raises(UrdfError, match="body.stl is missing; put the file there, or leave out meshes"):
        read_description(path)
    with pytest.raises(
        UrdfError, match="no wheel, track or flipper has a shape: the meshes of wheel_link are left out"
    ):
        convert(path, ignore_meshes=True)
    four = [wheel(f"{name}_wheel", place) for name, place in
            (("fl", "0.2 0.2 0"), ("fr", "0.2 -0.2 0"), ("rl", "-0.2 0.2 0"), ("rr", "-0.2 -0.2 0"))]  # fmt: skip
    found = convert(robot(tmp_path, *body, *wheels, *four), ignore_meshes=True)
    assert any("so that base_link, wheel_link cannot touch anything" in warning for warning in found.warnings)
    assert any("wheel_link: neither wheel, track nor flipper" in guess for guess in found.guesses)
    # A simple visual shape takes the place of a collision mesh that is left out.
    shaped = wheels[0].replace("</link>", '<visual><geometry><sphere radius="0.1"/></geometry></visual></link>')
    found = convert(robot(tmp_path, *body, shaped, wheels[1], *four[1:]), ignore_meshes=True)
    assert len(found.content["wheels"]) == 4


def test_track_width_sides_and_placeholder_limits(tmp_path):
    fast = '<limit effort="1" velocity="100"/>'
    steering = '<limit lower="-1.57" upper="1.57" effort="1" velocity="3"/>'
    path = robot(
        tmp_path,
        link("base_link", box("0.8 0.3 0.2", "0.3 0 0.1"), mass=20.0),
        link("fork", mass=0.2),
        joint("steer", "revolute", "base_link", "fork", "0.6 0 0", "0 0 1", steering),
        wheel("front_wheel", "0 0 0", "fork", extra=fast),
        wheel("left_wheel", "0 -0.25 0", extra=fast),
        wheel("right_wheel", "0 0.25 0", extra=fast),
    )
    found = convert(path)
    # The front wheel is on neither side.
    assert found.content["command"] == {"track_width": 0.5}
    assert any("wheel left lies on the right, y = -0.25 m" in warning for warning in found.warnings)
    assert any("the limits -1.57 to 1.57 rad in the file, 1.4 rad are taken" in guess for guess in found.guesses)
    downwards = path.read_text().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 -1"/>')
    path.write_text(downwards)
    assert any(
        "steering steer: positive angles in this description steer to the right" in w for w in convert(path).warnings
    )


def test_a_link_named_tracker_is_no_track(tmp_path):
    tracker = [link("tracker_mast", box("0.3 0.05 0.05"), mass=1.0),
               joint("mast", "fixed", "base_link", "tracker_mast", "0 0 0.3")]  # fmt: skip
    four = [wheel(f"{name}_wheel", place) for name, place in
            (("fl", "0.2 0.2 0"), ("fr", "0.2 -0.2 0"), ("rl", "-0.2 0.2 0"), ("rr", "-0.2 -0.2 0"))]  # fmt: skip
    found = convert(robot(tmp_path, link("base_link", box("0.3 0.2 0.1"), mass=9.0), *tracker, *four))
    assert "tracks" not in found.content


def test_placeholders_of_the_inertia_are_reported(tmp_path):
    four = [wheel(f"{name}_wheel", place) for name, place in
            (("fl", "0.2 0.2 0"), ("fr", "0.2 -0.2 0"), ("rl", "-0.2 0.2 0"), ("rr", "-0.2 -0.2 0"))]  # fmt: skip
    for inertia, reported in ((0.3, False), (100.0, True)):
        body = link("base_link", box("0.4 0.3 0.1"), mass=9.0, inertia=inertia)
        found = convert(robot(tmp_path, body, *four))
        assert any("radius of gyration of 3.0" in warning for warning in found.warnings) == reported


MACRO = """<robot name="bot" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:include filename="$(find bot_description)/urdf/body.xacro"/></robot>"""


@pytest.mark.skipif(shutil.which("xacro") is None, reason="xacro is not installed")
def test_packages_of_macro_files_are_found_by_option_or_beside_the_file(tmp_path, capsys):
    path = tmp_path / "elsewhere" / "bot.urdf.xacro"
    path.parent.mkdir()
    path.write_text(MACRO)
    assert main([str(path), "--out", str(tmp_path / "a.yaml")]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and "needs the package bot_description" in printed
    assert "--package bot_description=FOLDER" in printed
    package = tmp_path / "bot_description"
    (package / "urdf").mkdir(parents=True)
    body = robot(tmp_path, *small_robot()).read_text()
    (package / "urdf" / "body.xacro").write_text(body.replace('name="robot"', ""))
    assert "base_link" in read_description(path).links  # beside the file's folder
    moved = tmp_path / "workspace" / "anywhere"
    package.rename(tmp_path / "hidden")
    moved.mkdir(parents=True)
    (tmp_path / "hidden" / "urdf").rename(moved / "urdf")
    with pytest.raises(UrdfError, match="needs the package bot_description"):
        read_description(path)
    assert "base_link" in read_description(path, packages={"bot_description": moved}).links
    (moved / "urdf" / "body.xacro").unlink()
    with pytest.raises(UrdfError, match="xacro failed: .*body.xacro") as caught:
        read_description(path, packages={"bot_description": moved})
    assert "\n" not in str(caught.value)


def test_errors_of_the_loader_name_the_description(tmp_path, capsys):
    path = robot(tmp_path, *small_robot())
    path.write_text(path.read_text().replace('mass value="4.0"', 'mass value="9e6"'))
    assert main([str(path), "--out", str(tmp_path / "out.yaml")]) == 2
    printed = capsys.readouterr().err
    assert f"{path}: not a valid robot: mass" in printed and ".out.yaml" not in printed


def test_wheels_that_roll_freely_are_drawn_so(tmp_path):
    path = car_along_y(tmp_path)
    conversion = convert(path, forward="-y")
    out = tmp_path / "out.yaml"
    out.write_text(robot_file_text(conversion, path))
    labels = draw_robot(load_robot(out), conversion.content).axes[2].get_legend_handles_labels()[1]
    assert "rolls freely" in labels


def caster(angle, kind="continuous", extra=""):
    """A fork that is drawn turned by an angle, and its wheel behind it."""
    shape = round_shape('cylinder radius="0.05" length="0.02"', "1.5707963 0 0")
    return (
        link("fork_link", mass=0.2)
        + joint("fork", kind, "base_link", "fork_link", "-0.3 0 0", "0 0 1", extra, rpy=f"0 0 {angle}")
        + link("roller_link", shape, mass=0.2, inertia=0.001)
        + joint("roller", "continuous", "fork_link", "roller_link", "-0.03 0 -0.05")
    )


@pytest.mark.parametrize("angle", [0.7, -1.2, 1.5, 2.9])
def test_casters_that_are_drawn_turned_are_straightened(tmp_path, angle):
    straight, turned = (
        convert(robot(tmp_path, *small_robot(caster(drawn)), name=f"robot{number}.urdf"))
        for number, drawn in enumerate((0.0, angle))
    )
    assert [wheel["name"] for wheel in turned.content["wheels"]] == ["left", "right", "roller"]
    found, expected = turned.content["wheels"][2]["centre"], straight.content["wheels"][2]["centre"]
    # The wheel may lie in front of the fork as well as behind it: it trails as soon as the robot drives.
    pivot = turned.content["casters"][0]["pivot"]
    assert abs(found[0] - pivot[0]) == pytest.approx(0.03, abs=1e-5)
    assert found[1:] == pytest.approx(expected[1:], abs=1e-5)
    assert any("fork: drawn turned to the side" in warning for warning in turned.warnings)
    assert not any("drawn turned" in warning for warning in straight.warnings)


def test_two_wheels_beside_each_other_on_one_swivel_are_one_wheel(tmp_path):
    """Twin casters, as of office chairs: one strip, with the mass of both and no hull in its place."""
    second = wheel("other", "-0.03 0.06 -0.05", parent="fork_link", radius=0.05)
    one, both = (
        convert(robot(tmp_path, *small_robot(caster(0.0) + more), name=f"robot{number}.urdf"))
        for number, more in enumerate(("", second))
    )
    assert [entry["name"] for entry in both.content["wheels"]] == ["left", "right", "roller"]
    alone, joined = one.content["wheels"][2], both.content["wheels"][2]
    edges = [entry["centre"][1] - entry["width"] / 2 for entry in (alone, joined)]
    assert edges[0] == pytest.approx(edges[1], abs=1e-5) and joined["radius"] == alone["radius"]
    assert joined["width"] > 0.06 + alone["width"] / 2
    assert both.content["mass"] > one.content["mass"] and both.content["hull"] == one.content["hull"]
    assert any("run beside each other and are one wheel" in guess for guess in both.guesses)
    assert len(both.content["casters"]) == 1


def test_two_wheels_on_one_vertical_joint_are_refused_with_what_to_do(tmp_path):
    """An axle, or a wheel behind the other one."""
    second = wheel("other", "-0.2 0.02 -0.05", parent="fork_link", radius=0.05)
    path = robot(tmp_path, *small_robot(caster(0.0) + second))
    with pytest.raises(UrdfError, match="joint fork turns the wheels .*not supported; leave one of a pair out"):
        convert(path)
    assert len(convert(path, hints={"other_link": "ignore"}).content["wheels"]) == 3


def test_a_body_without_mass_and_an_inertia_of_a_point_are_reported(tmp_path):
    parts = (caster(0.0), wheel("left_wheel", "0 0.15 0"), wheel("right_wheel", "0 -0.15 0"))
    shape = box("0.7 0.45 0.2", "0 0 0.1")
    found = convert(robot(tmp_path, link("base_link", shape), *parts))
    assert any("without mass: the body, base_link" in warning for warning in found.warnings)
    found = convert(robot(tmp_path, link("base_link", shape, mass=25.0, inertia=1e-3), *parts))
    assert any("inertia of base_link: a radius of gyration of 0.6 cm" in warning for warning in found.warnings)
    found = convert(robot(tmp_path, link("base_link", shape, mass=25.0, inertia=0.5), *parts))
    assert not any("inertia of" in warning or "without mass" in warning for warning in found.warnings)


def test_a_tilted_steering_axis_is_said(tmp_path):
    limits = '<limit lower="-0.6" upper="0.6" velocity="1" effort="1"/>'
    fork = (
        link("fork_link", mass=0.2)
        + joint("fork", "revolute", "base_link", "fork_link", "0.4 0 0", "-0.26 0 0.966", limits)
        + wheel("front", "0.05 0 0", parent="fork_link")
    )
    found = convert(robot(tmp_path, *small_robot(fork)))
    assert any("fork: turns front about an axis that is tilted by 15°" in guess for guess in found.guesses)


def test_a_number_with_a_comma_is_named_with_its_place(tmp_path):
    path = robot(tmp_path, *small_robot(caster(0.0)))
    path.write_text(path.read_text().replace('<mass value="4.0"/>', '<mass value="4,0"/>'))
    with pytest.raises(UrdfError, match="link base_link: mass: value: got '4,0', expected numbers with a decimal"):
        read_description(path)


def test_wheels_that_roll_sideways_are_said_to_be_imported_as_plain_ones(tmp_path):
    wheels = [
        wheel(f"{name}_{i}", f"{x} {y} 0")
        for i, (name, x, y) in enumerate(
            [("mecanum_fl", 0.2, 0.2), ("mecanum_fr", 0.2, -0.2), ("rear_left", -0.2, 0.2), ("rear_right", -0.2, -0.2)]
        )
    ]
    path = robot(tmp_path, link("base_link", box("0.5 0.3 0.1"), mass=20.0), *wheels)
    (warning,) = [text for text in convert(path).warnings if "sideways" in text]
    assert "mecanum_fl_0_link, mecanum_fr_1_link" in warning and "rear" not in warning


def test_lidars_are_known_by_their_usual_names_and_their_absence_is_said(tmp_path):
    wheels = [wheel(f"wheel_{i}", f"{x} {y} 0") for i, (x, y) in enumerate([(0.2, 0.2), (0.2, -0.2), (-0.2, 0.2)])]
    body = link("base_link", box("0.5 0.3 0.1"), mass=20.0)
    for name in ("os0_sensor", "pandar", "front_laser"):
        mounted = link(name) + joint("mount", "fixed", "base_link", name, "0.1 0 0.4")
        conversion = convert(robot(tmp_path, body, *wheels, mounted))
        assert conversion.content["sensors"][name]["translation"] == [0.1, 0.0, 0.4]
        assert not any("no camera or lidar" in text for text in conversion.guesses)
    assert any("no camera or lidar" in text for text in convert(robot(tmp_path, body, *wheels)).guesses)


def test_a_ball_of_the_root_link_itself_is_a_caster(tmp_path):
    balls = "".join(
        f'<collision><origin xyz="{x} 0 -0.07"/><geometry><sphere radius="0.03"/></geometry></collision>'
        for x in (-0.12, 0.12)
    )
    base, *wheels = small_robot()
    path = robot(tmp_path, base.replace("</link>", f"{balls}</link>"), *wheels)
    found = convert(path)
    assert len(found.content["casters"]) == 2 and found.content["drive"]["kind"] == "differential"
    place = next(entry for entry in found.content["wheels"] if entry["drive"] is None)
    np.testing.assert_allclose(place["centre"], [-0.12, 0.0, -0.07], atol=1e-5)
    assert imported(path, tmp_path)[0] == 0


def test_wheels_that_follow_one_of_their_side_are_driven_as_it_is(tmp_path):
    parts = [link("base_link", box("0.9 0.4 0.1", "0 0 0.1"), mass=20.0)]
    for y, side in ((0.3, "left"), (-0.3, "right")):
        for x, place in ((0.35, "front"), (0.0, "middle"), (-0.35, "rear")):
            follows = "" if place == "front" else f'<mimic joint="{side}_front"/>'
            parts.append(wheel(f"{side}_{place}", f"{x} {y} 0", extra=follows))
    path = robot(tmp_path, *parts)
    assert len(convert(path).content["wheels"]) == 6
    assert imported(path, tmp_path)[0] == 0


def test_what_turns_about_a_lateral_axis_in_the_air_is_no_wheel(tmp_path):
    elbow = (
        link("fore_arm", box("0.05 0.3 0.05"), mass=0.1),
        joint("elbow", "continuous", "base_link", "fore_arm", "0 0 0.5"),
    )
    path = robot(tmp_path, *small_robot(*elbow))
    found = convert(path)
    assert len(found.content["wheels"]) == 2
    assert any("elbow" in guess and "--hint elbow=wheel" in guess for guess in found.guesses)
    assert len(convert(path, hints={"elbow": "wheel"}).content["wheels"]) == 3


def test_a_robot_whose_wheels_sink_into_firm_ground_is_told_so(tmp_path, capsys):
    def heavy(mass):
        base = link("base_link", box("0.9 0.4 0.1", "0 0 0.1"), mass=mass)
        places = [(x, y) for x in (0.35, -0.35) for y in (0.3, -0.3)]
        return robot(tmp_path, base, *(wheel(f"w{i}", f"{x} {y} 0") for i, (x, y) in enumerate(places)))

    assert imported(heavy(30.0), tmp_path)[0] == 0
    assert "sinks" in capsys.readouterr().out
    assert imported(heavy(900.0), tmp_path)[0] != 0
    assert "terrain_softness" in capsys.readouterr().out
