"""Installation: lower bounds agree wherever they are stated, files for containers, no mix with a sourced ROS."""

import json
import os
import re
import subprocess
import xml.etree.ElementTree as ElementTree

import pytest
import yaml
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.version import Version

# What rosdep installs from Ubuntu, by its name on PyPI.
SYSTEM_PACKAGES = {
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "opencv-python-headless": "python3-opencv",
    "pyyaml": "python3-yaml",
    "scipy": "python3-scipy",
    "tqdm": "python3-tqdm",
}


def lines(name: str) -> list[Requirement]:
    texts = [line.split("#")[0].strip() for line in (ROOT / name).read_text().splitlines()]
    return [Requirement(text) for text in texts if text and not text.startswith("-")]


def lowest(requirement: Requirement) -> Version:
    (bound,) = [s.version for s in requirement.specifier if s.operator == ">="]
    return Version(bound)


def pinned(name: str) -> dict[str, Version]:
    return {r.name.lower(): Version(next(iter(r.specifier)).version) for r in lines(name) if "==" in str(r.specifier)}


def setup_requirements() -> dict[str, Requirement]:
    listed = (ROOT / "setup.py").read_text().split("install_requires=[")[1].split("]")[0]
    found = [Requirement(text) for text in re.findall(r'"([^"]+)"', listed)]
    return {r.name: r for r in found if r.name != "setuptools"}


def system_versions() -> dict[str, Version]:
    depends = ElementTree.parse(ROOT / "package.xml").getroot().findall("exec_depend")
    return {d.text: Version(d.get("version_gte")) for d in depends if d.get("version_gte")}


def test_the_lowest_versions_are_tested_and_stated_alike():
    bounds = setup_requirements()
    tested = {r.name: lowest(r) for r in lines("requirements-lowest.in") if r.name in {*bounds, *SYSTEM_PACKAGES}}
    assert set(tested) == {*bounds, "opencv-python-headless"}
    locked, stated = pinned("requirements-lowest.lock"), system_versions()
    assert {name: locked[name] for name in tested} == tested
    for name, version in tested.items():
        if name in SYSTEM_PACKAGES:
            # Micro releases of Ubuntu's package do not matter; matplotlib 3.6 has no wheel for Python 3.12.
            bound = stated[SYSTEM_PACKAGES[name]]
            assert version.release[:2] == bound.release[:2] or name == "matplotlib"
            assert version >= bound
        if name in bounds and name not in SYSTEM_PACKAGES:
            assert lowest(bounds[name]) == version
    for name, requirement in bounds.items():
        if name in SYSTEM_PACKAGES:
            assert lowest(requirement).release[:2] == stated[SYSTEM_PACKAGES[name]].release[:2]


def test_pip_installs_on_a_robot_what_rosdep_does_not_with_the_same_bounds():
    bounds = {name: str(r.specifier) for name, r in setup_requirements().items() if name not in SYSTEM_PACKAGES}
    assert {r.name: str(r.specifier) for r in lines("requirements-robot.txt")} == bounds
    constraints = pinned("constraints-jazzy.txt")
    # A newer NumPy in the virtual environment breaks the packages that Ubuntu built against its own.
    assert set(constraints) == set(SYSTEM_PACKAGES) - {"opencv-python-headless"}
    stated = system_versions()
    assert all(version >= stated[SYSTEM_PACKAGES[name]] for name, version in constraints.items())
    assert "-c constraints-jazzy.txt" in (ROOT / "requirements-robot.txt").read_text().splitlines()


def test_the_page_states_the_lowest_versions():
    page = (ROOT / "docs" / "install.md").read_text()
    table = dict(re.findall(r"^\| (\S+) \| ([\d.]+) \| [\w.]+ \|$", page, re.MULTILINE))
    expected = {name: str(lowest(r)) for name, r in setup_requirements().items()}
    expected["opencv"] = str(system_versions()["python3-opencv"])
    assert {name.lower(): version for name, version in table.items()} == expected


def test_the_lock_is_what_the_lowest_requirements_resolve_to():
    """Each direct requirement is satisfied by its pin; the rest is uv's business."""
    locked = pinned("requirements-lowest.lock")
    for requirement in lines("requirements-lowest.in"):
        assert requirement.specifier.contains(locked[requirement.name.lower()]), requirement


def test_a_sourced_ros_is_left_out(tmp_path):
    other, library = tmp_path / "opt" / "jazzy", tmp_path / "opt" / "jazzy" / "lib"
    packages = library / "python3.12" / "site-packages"
    (packages / "rclpy").mkdir(parents=True)
    (packages / "rclpy" / "__init__.py").write_text("raise ImportError('built for another Python')\n")
    kept = tmp_path / "my_modules"
    environment = {
        "PATH": f"{other}/bin:{os.environ['PATH']}",
        "HOME": os.environ.get("HOME", "/"),
        "AMENT_PREFIX_PATH": str(other),
        "CMAKE_PREFIX_PATH": str(other),
        "COLCON_PREFIX_PATH": str(tmp_path / "opt"),
        "LD_LIBRARY_PATH": f"{library}/x86_64-linux-gnu:{library}",
        "PYTHONPATH": f"{packages}:{kept}",
        "ROS_DISTRO": "jazzy",
    }
    script = "import os, rclpy; print(rclpy.__file__); print(dict(os.environ))"
    ended = subprocess.run(
        [str(ROOT / "scripts" / "run.sh"), "python", "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    module, shown = ended.stdout.splitlines()
    assert module.startswith(str(ROOT))
    for variable in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "PATH"):
        assert str(other) not in (yaml.safe_load(shown).get(variable) or ""), variable
    assert str(kept) in yaml.safe_load(shown)["PYTHONPATH"]
    assert f"leaving out the sourced ROS of {other}" in ended.stderr


def test_run_within_run_says_nothing(tmp_path):
    run = str(ROOT / "scripts" / "run.sh")
    environment = {k: v for k, v in os.environ.items() if k not in ("AMENT_PREFIX_PATH", "PYTHONPATH")}
    ended = subprocess.run([run, run, "true"], env=environment, capture_output=True, text=True, timeout=60, check=True)
    assert ended.stderr == ""


def test_messages_are_built_with_the_headers_of_the_environment_wherever_it_was_before(tmp_path):
    folder = tmp_path / "share" / "std_msgs" / "cmake"
    folder.mkdir(parents=True)
    target = '  INTERFACE_INCLUDE_DIRECTORIES "{};{};${{_IMPORT_PREFIX}}/include/std_msgs"\n'
    packages = "lib/python3.12/site-packages/numpy/_core/include"
    old = {
        "wheel": ("/opt/python/cp312/include/python3.12", f"/opt/python/cp312/{packages}"),
        "moved": ("/usr/include/python3.12", f"{tmp_path}/old/.venv/{packages}"),
    }
    for name, folders in old.items():
        (folder / f"{name}.cmake").write_text(target.format(*folders))
    (folder / "plain.cmake").write_text('set(x "${_IMPORT_PREFIX}/include/std_msgs")\n')
    headers, arrays = "/h/include/python3.12", "/a/numpy/include"
    script = f"root=/; source {ROOT}/scripts/environment.sh; set_include_folders {tmp_path} {headers} {arrays}"
    for _ in range(2):
        subprocess.run(["bash", "-euo", "pipefail", "-c", script], check=True)
    for name in old:
        assert (folder / f"{name}.cmake").read_text() == target.format(headers, arrays)
    assert (folder / "plain.cmake").read_text() == 'set(x "${_IMPORT_PREFIX}/include/std_msgs")\n'


def test_the_container_takes_the_steps_of_the_page():
    page = (ROOT / "docs" / "install.md").read_text()
    dockerfile = re.sub(r"\\\n\s*", "", (ROOT / "Dockerfile").read_text())
    for step in ("rosdep install --from-paths src --ignore-src -r -y", "venv --system-site-packages .venv"):
        assert step in page and step in dockerfile
    for line in dockerfile.splitlines():
        if line.startswith("COPY ") and not line.startswith("COPY . "):
            for source in line.split()[1:-1]:
                assert (ROOT / source).is_file(), source
    assert "https://download.pytorch.org/whl/cpu" in page and "https://download.pytorch.org/whl/cpu" in dockerfile
    assert "python -m colcon build" in page and "python -m colcon build" in dockerfile


@pytest.mark.parametrize("name", ["tests.yml", "jazzy.yml"])
def test_workflows_run_what_exists(name):
    content = yaml.safe_load((ROOT / ".github" / "workflows" / name).read_text())
    steps = [step["run"] for job in content["jobs"].values() for step in job["steps"] if "run" in step]
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"\bmake ([\w-]+)", "\n".join(steps)):
        assert re.search(rf"^{target}\b[^:=]*:", makefile, re.MULTILINE), target
    for path in re.findall(r"\btest/test_\w+\.py", "\n".join(steps)):
        assert (ROOT / path).is_file(), path


def test_the_development_container_builds_the_same_image():
    text = (ROOT / ".devcontainer" / "devcontainer.json").read_text()
    content = json.loads(re.sub(r"^\s*//.*$", "", text, flags=re.MULTILINE))
    assert (ROOT / ".devcontainer" / content["build"]["dockerfile"]).resolve() == ROOT / "Dockerfile"
