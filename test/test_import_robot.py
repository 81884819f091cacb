"""Robot files from URDF: numbers of seven kinds of robots, and one clear message for each kind of bad file."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml

from monoforce_ros.importing import check_robot, draw_robot
from monoforce_ros.importing.cli import main, robot_file_text
from monoforce_ros.robots import (
    ConversionOptions,
    RobotFileError,
    UrdfError,
    convert_description,
    load_robot,
    read_description,
)

FOLDER = Path(__file__).parent / "robots"
KINDS = {
    "skid_large": "skid", "skid_small": "skid", "skid_rocker": "skid", "tracked_flippers": "skid",
    "ackermann_car": "ackermann", "four_wheel_steering_rover": "four_wheel_steering",
    "differential_caster": "differential",
}  # fmt: skip


def converted(kind, **options):
    return convert_description(read_description(FOLDER / f"{kind}.urdf"), ConversionOptions(**options))


def entry(conversion, section, name):
    return next(item for item in conversion.content[section] if item["name"] == name)


def write(tmp_path, text):
    path = tmp_path / "robot.urdf"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", sorted(KINDS))
def test_every_description_becomes_a_robot_that_stands_drives_and_turns(name, tmp_path):
    out = tmp_path / "robot.yaml"
    assert main([str(FOLDER / f"{name}.urdf"), "--out", str(out)]) == 0
    robot, content = load_robot(out), yaml.safe_load(out.read_text())
    assert content == dict(converted(name).content)
    assert float(robot.mass) == pytest.approx(content["mass"])
    assert (tmp_path / "robot.png").stat().st_size > 20_000


@pytest.mark.parametrize("name", sorted(KINDS))
def test_the_drive_is_recognised(name):
    assert converted(name).content.get("drive", {"kind": "skid"})["kind"] == KINDS[name]


def test_a_large_skid_steered_robot_has_the_numbers_of_its_description():
    found = converted("skid_large")
    content = found.content
    assert content["base_frame"] == "base_link" and content["mass"] == pytest.approx(50.4)
    # Body 40 kg at z = 0.08, four wheels of 2.6 kg at z = 0.03282.
    assert content["centre_of_mass"] == pytest.approx([0.0, 0.0, (40 * 0.08 + 10.4 * 0.03282) / 50.4], abs=1e-6)
    wheel = entry(found, "wheels", "front_left")
    assert wheel == {
        "name": "front_left", "drive": "left", "centre": [0.256, 0.2854, 0.03282], "radius": 0.1651, "width": 0.1143
    }  # fmt: skip
    assert content["command"]["track_width"] == pytest.approx(0.5708)
    # Parallel axes: I_zz of the body, and of wheels with their own moments at (0.256, 0.2854).
    own = 2.6 * (3 * 0.1651**2 + 0.1143**2) / 12
    assert content["inertia"][2] == pytest.approx(3.2 + 4 * (own + 2.6 * (0.256**2 + 0.2854**2)), rel=1e-4)
    assert [box["size"] for box in content["hull"]] == [[0.98, 0.42, 0.12], [0.78, 0.42, 0.12]]
    assert set(content["sensors"]) == {"camera_front_optical_frame", "velodyne", "imu_link"}
    camera = load_pose(content["sensors"]["camera_front_optical_frame"])
    # The optical axis looks forward and 0.25 rad down, the image's right is the robot's.
    assert camera[:3, 2] == pytest.approx([np.cos(0.25), 0.0, -np.sin(0.25)], abs=1e-6)
    assert camera[:3, 0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-6)


def load_pose(sensor):
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(sensor["quaternion"]).as_matrix(), sensor["translation"]
    return pose


def test_velocity_limits_axes_to_the_right_and_spinning_lidars():
    found = converted("skid_small")
    assert found.content["command"]["maximum_speed"] == pytest.approx(20.4 * 0.098, rel=1e-4)
    assert {wheel["drive"] for wheel in found.content["wheels"]} == {"left", "right"}
    assert "joint front_laser_spin (continuous): held at 0" in found.guesses
    assert [wheel["centre"][1] > 0 for wheel in found.content["wheels"]] == [True, True, False, False]


def test_rockers_carry_their_wheels():
    found = converted("skid_rocker", hints={"left_rocker_joint": "rocker"})
    left = entry(found, "rockers", "left_rocker_joint")
    assert left["wheels"] == ["front_left", "rear_left"] and left["pivot"] == [0.0, 0.43, 0.16]
    assert left["limit"] == pytest.approx(0.18)
    rear = load_pose(found.content["sensors"]["camera_rear_optical_frame"])
    assert rear[0, 2] < -0.9


def test_a_car_is_steered_in_front_and_driven_behind():
    found = converted("ackermann_car")
    assert (
        entry(found, "wheels", "front_left")["drive"] is None and entry(found, "wheels", "rear_left")["drive"] == "rear"
    )
    steering = entry(found, "steering", "front_left_steering_joint")
    assert steering == {
        "name": "front_left_steering_joint", "wheel": "front_left", "maximum_angle": 0.61, "maximum_rate": 0.8,
        "pivot": [2.65, 0.7, 0.0],
    }  # fmt: skip


def test_a_rover_steers_and_drives_each_wheel():
    content = converted("four_wheel_steering_rover").content
    assert len(content["steering"]) == 4 and len({wheel["drive"] for wheel in content["wheels"]}) == 4
    assert {"camera_left_optical_frame", "camera_right_optical_frame", "imu"} == set(content["sensors"])


def test_casters_swivel_and_are_not_driven():
    found = converted("differential_caster")
    (caster,) = found.content["casters"]
    assert caster["pivot"] == [-0.18, 0.0, 0.0] and caster["wheel"] == "caster"
    assert entry(found, "wheels", "caster")["drive"] is None
    steered = converted("differential_caster", hints={"caster_swivel": "steering"})
    assert steered.content["drive"]["kind"] == "ackermann" and "casters" not in steered.content


def test_tracks_and_flippers():
    found = converted("tracked_flippers")
    track = entry(found, "tracks", "left_track")
    assert track["length"] == pytest.approx(0.5) and track["radius"] == pytest.approx(0.09)
    flippers = found.content["flippers"]
    assert len(flippers) == 4 and "wheels" not in found.content
    for flipper in flippers:
        assert flipper["angle"] == pytest.approx(0.5, abs=1e-5) and flipper["length"] == pytest.approx(0.3)
        assert (flipper["root_radius"], flipper["tip_radius"], flipper["mass"]) == (0.089, 0.04, 1.6)
        assert flipper["end"] == ("front" if flipper["joint"][0] > 0 else "rear")
    # Positive angles raise the tip: of the front flippers' axis (0, 1, 0) that is the negative direction.
    assert entry(found, "flippers", "front_left_flipper_joint")["limits"] == pytest.approx(
        [0.5 - 1.2, 0.5 + 2.0], abs=1e-5
    )
    assert entry(found, "flippers", "rear_left_flipper_joint")["limits"] == pytest.approx(
        [0.5 - 2.0, 0.5 + 1.2], abs=1e-5
    )
    assert found.content["command"]["track_width"] == pytest.approx(2 * 0.2485, abs=1e-4)


def test_hints_go_before_guesses():
    found = converted("skid_large", hints={"front_left_wheel_joint": "fixed", "front_right_wheel_joint": "free_wheel"})
    assert [wheel["name"] for wheel in found.content["wheels"]] == ["rear_left", "front_right", "rear_right"]
    assert entry(found, "wheels", "front_right")["drive"] is None
    assert any(box["name"] == "front_left_wheel_link" for box in found.content["hull"])
    lighter = converted("four_wheel_steering_rover", hints={"mast": "ignore"})
    assert lighter.content["mass"] == pytest.approx(84.0)
    assert not any("mast" in box["name"] for box in lighter.content["hull"])
    turned = converted("ackermann_car", base_frame="lidar_top", name="My Car!")
    assert turned.content["name"] == "my_car" and entry(turned, "wheels", "rear_left")["centre"] == [-1.2, 0.76, -1.4]


ROBOT = (FOLDER / "skid_small.urdf").read_text()
WHEEL = re.compile(r'<joint name="front_left_wheel" type="continuous">.*?</joint>', re.DOTALL)
BAD = {
    "no masses": (lambda t: re.sub(r"<inertial>.*?</inertial>", "", t, flags=re.DOTALL), "none of the .* has a mass"),
    "negative mass": (lambda t: t.replace('mass value="16.4"', 'mass value="-1"'), "link chassis_link: mass: got -1"),
    "NaN mass": (lambda t: t.replace('mass value="16.4"', 'mass value="nan"'), "link chassis_link: mass: got nan"),
    "loop": (
        lambda t: t.replace(
            "</robot>",
            '<joint name="again" type="fixed"><parent link="front_laser"/><child link="imu_link"/></joint></robot>',
        ),
        "imu_link hangs on the joints imu_joint and again: a closed kinematic loop",
    ),
    "no root": (
        lambda t: t.replace(
            "</robot>",
            '<joint name="up" type="fixed"><parent link="imu_link"/><child link="base_link"/></joint></robot>',
        ),
        "every link has a parent: a loop",
    ),
    "two roots": (lambda t: t.replace("</robot>", '<link name="alone"/></robot>'), "alone, base_link have no parent"),
    "unknown link": (lambda t: t.replace('<child link="imu_link"/>', '<child link="imu"/>'), "'imu' does not exist"),
    "mimic": (
        lambda t: WHEEL.sub(lambda m: m.group(0).replace("</joint>", '<mimic joint="rear_right_wheel"/></joint>'), t),
        "front_left_wheel mimics rear_right_wheel.*except wheels that follow one of their side",
    ),
    "wrong axes": (
        lambda t: t.replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"').replace('axis xyz="0 -1 0"', 'axis xyz="1 0 0"'),
        r"no wheel, track or flipper found: joint front_left_wheel: its axis is \(1, 0, 0\)",
    ),
    "lying cylinder": (lambda t: t.replace('rpy="1.5707963 0 0"', 'rpy="0 0 0"'), "lies along .* turn the shape"),
    "missing mesh": (
        lambda t: t.replace('<box size="0.42 0.31 0.184"/>', '<mesh filename="package://nobody/body.stl"/>'),
        "link chassis_link: the mesh package://nobody/body.stl is missing.*--package nobody=FOLDER.*--ignore-meshes",
    ),
    "no size": (lambda t: t.replace('length="0.04"', 'length="-0.04"'), "cylinder radius and length: got .*-0.04"),
    "infinite origin": (lambda t: t.replace('xyz="0 0 0.05"', 'xyz="0 0 inf"'), "joint imu_joint: origin"),
    "bad inertia": (lambda t: re.sub(r'ixx="[\d.]+"', 'ixx="-5"', t, count=1), "negative principal moment"),
    "entities": (
        lambda t: '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>' + t.split("?>")[1],
        "<!DOCTYPE: document types and entities are refused",
    ),
    "not XML": (lambda t: t[:-20], "not XML"),
    "not a URDF": (lambda t: "<sdf version='1.9'/>", "the root element is 'sdf'"),
    "two of a name": (lambda t: t.replace('<link name="imu_link"/>', '<link name="imu_link"/>\n' * 2), "same name"),
}  # fmt: skip


@pytest.mark.parametrize("case", sorted(BAD))
def test_a_bad_description_gives_one_clear_message(tmp_path, capsys, case):
    change, message = BAD[case]
    text = change(ROBOT)
    assert text != ROBOT
    path, out = write(tmp_path, text), tmp_path / "out.yaml"
    with pytest.raises(UrdfError, match=message) as caught:
        convert_description(read_description(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert main([str(path), "--out", str(out)]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("import_robot: ") and printed.err.count("\n") == 1 and not printed.out
    assert not out.exists()


def test_large_files_and_other_encodings_are_refused(tmp_path):
    path = write(tmp_path, "<robot name='a'>" + " " * 10_000_001 + "</robot>")
    with pytest.raises(UrdfError, match="expected at most 10000000"):
        read_description(path)
    path.write_bytes(ROBOT.encode("utf-16"))
    with pytest.raises(UrdfError, match="not UTF-8"):
        read_description(path)
    with pytest.raises(UrdfError, match="does not exist"):
        read_description(tmp_path / "nowhere.urdf")


@pytest.mark.parametrize("suffix", ["stl", "obj", "dae"])
def test_meshes_count_with_their_convex_bounds(tmp_path, suffix, monkeypatch):
    mesh = tmp_path / "share" / "bodies" / "meshes" / f"body.{suffix}"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.box([420.0, 310.0, 184.0]).export(mesh)
    element = f'<mesh filename="package://bodies/meshes/body.{suffix}" scale="0.001 0.001 0.001"/>'
    path = write(tmp_path, ROBOT.replace('<box size="0.42 0.31 0.184"/>', element))
    expected = entry(converted("skid_small"), "hull", "chassis_link")
    by_option = convert_description(read_description(path, packages={"bodies": tmp_path / "share" / "bodies"}))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    for found in (by_option, convert_description(read_description(path))):
        hull = entry(found, "hull", "chassis_link")
        np.testing.assert_allclose(hull["size"], expected["size"], atol=1e-5)
        np.testing.assert_allclose(hull["centre"], expected["centre"], atol=1e-5)
    without = convert_description(read_description(path, ignore_meshes=True))
    assert not any(box["name"] == "chassis_link" for box in without.content["hull"])
    mesh.write_bytes(b"no mesh")
    with pytest.raises(UrdfError, match="not readable as a mesh"):
        read_description(path)


def test_a_wheel_may_be_a_mesh_or_a_sphere(tmp_path):
    wheel = trimesh.creation.cylinder(radius=0.098, height=0.04, sections=96)
    wheel.export(tmp_path / "wheel.stl")
    path = write(tmp_path, ROBOT.replace('<cylinder radius="0.098" length="0.04"/>', '<mesh filename="wheel.stl"/>'))
    found = entry(convert_description(read_description(path)), "wheels", "front_left")
    assert found["radius"] == pytest.approx(0.098, rel=1e-3) and found["width"] == pytest.approx(0.04)
    path = write(tmp_path, ROBOT.replace('<cylinder radius="0.098" length="0.04"/>', '<sphere radius="0.098"/>'))
    found = entry(convert_description(read_description(path)), "wheels", "front_left")
    assert found["radius"] == pytest.approx(0.098)


def test_xacro_is_expanded_where_it_is_installed(tmp_path, monkeypatch):
    path = tmp_path / "robot.urdf.xacro"
    text = ROBOT.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1)
    text = text.replace("<link ", '<xacro:arg name="load" default="1.0"/>\n<link ', 1)
    text = text.replace('mass value="16.4"', "mass value=\"${16.4 + float('$(arg load)')}\"")
    path.write_text(text)
    with monkeypatch.context() as without:
        without.setenv("PATH", str(tmp_path))
        with pytest.raises(UrdfError, match="xacro is not installed"):
            read_description(path)
    import shutil

    if shutil.which("xacro") is None:
        pytest.skip("xacro is not installed")
    assert read_description(path).links["chassis_link"].mass == pytest.approx(17.4)
    assert read_description(path, xacro_arguments=["load:=3.6"]).links["chassis_link"].mass == pytest.approx(20.0)
    with pytest.raises(UrdfError, match="expected name:=value"):
        read_description(path, xacro_arguments=["load=3"])


def test_the_check_fails_for_a_robot_that_cannot_move(tmp_path):
    text = robot_file_text(converted("skid_small"), FOLDER / "skid_small.urdf")
    heavy = yaml.safe_load(text)
    heavy["centre_of_mass"] = [0.4, 0.0, 0.2]
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(heavy))
    findings = {finding.name: finding for finding in check_robot(load_robot(tmp_path / "a.yaml"))}
    assert not findings["stands still"].passed and "tip over" in findings["stands still"].text
    dragging = yaml.safe_load(text)
    dragging["hull"].append({"name": "skirt", "centre": [0.0, 0.0, -0.04], "size": [0.4, 0.3, 0.06]})
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(dragging))
    findings = {finding.name: finding for finding in check_robot(load_robot(tmp_path / "b.yaml"))}
    assert not findings["drives straight"].passed and "drag" in findings["drives straight"].text


def test_names_cannot_add_keys_to_the_file(tmp_path):
    text = ROBOT.replace('"front_left_wheel"', '"a&#10;effects: [{name: payload, parameters: {mass: 9}}]"')
    conversion = convert_description(read_description(write(tmp_path, text)))
    out = tmp_path / "robot.yaml"
    out.write_text(robot_file_text(conversion, Path("robot.urdf")))
    assert load_robot(out).effects == () and set(yaml.safe_load(out.read_text())) == set(conversion.content)


def test_files_are_not_overwritten_and_hints_are_checked(tmp_path, capsys):
    out, urdf = tmp_path / "robot.yaml", str(FOLDER / "skid_small.urdf")
    out.write_text("mine")
    assert main([urdf, "--out", str(out)]) == 2 and "exists" in capsys.readouterr().err
    assert out.read_text() == "mine"
    for arguments, message in (
        (["--hint", "nobody=wheel"], "no link or joint of this name"),
        (["--hint", "imu_link=antenna"], "expected one of wheel, free_wheel"),
        (["--hint", "imu_link"], "expected NAME=KIND"),
        (["--drive", "hover"], "expected one of skid, differential"),
        (["--base-frame", "base"], "base frame 'base': expected one of base_link"),
        (["--maximum-speed", "-1"], "--maximum-speed: got -1.0, expected 0.01 to 1000"),
    ):
        assert main([urdf, "--out", str(tmp_path / "other.yaml"), *arguments]) == 2
        assert message in capsys.readouterr().err


def test_the_picture_shows_points_wheels_and_cameras(tmp_path):
    conversion = converted("skid_large")
    out = tmp_path / "robot.yaml"
    out.write_text(robot_file_text(conversion, Path("robot.urdf")))
    robot = load_robot(out)
    figure = draw_robot(robot, conversion.content)
    space, side, above = figure.axes
    labels = set(above.get_legend_handles_labels()[1])
    assert {"hull", "driven, left", "driven, right", "camera", "lidar", "IMU", "centre of mass"} <= labels
    # Two boxes, four wheels and four faces of the camera's view, from the side and from above.
    assert len(side.patches) - 1 == len(above.patches) == 2 + 4 + 4
    assert len(space.collections) > 10 and torch.isfinite(robot.points).all()


def test_a_file_that_the_loader_refuses_is_not_left_behind(tmp_path, capsys):
    path = write(tmp_path, ROBOT.replace('mass value="16.4"', 'mass value="9e6"'))
    out = tmp_path / "robot.yaml"
    assert main([str(path), "--out", str(out)]) == 2
    assert "mass" in capsys.readouterr().err and list(tmp_path.iterdir()) == [path]
    with pytest.raises(RobotFileError):
        load_robot(out)
