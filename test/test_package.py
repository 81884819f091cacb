"""The package as seen by ROS tools, and the documents that are generated from its files."""

import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from conftest import INSTALLED, ROOT

from monoforce_ros.nodes.schema import read_schema

SETUP = (ROOT / "setup.py").read_text()
EXECUTABLES = [
    "bag_player",
    "bag_recorder",
    "convert",
    "diagnose",
    "evaluate",
    "fit_terrain",
    "import_robot",
    "train",
    "path_selector",
    "simulator",
    "predictor",
    "synthesize",
]


def test_colcon_recognises_an_ament_python_package(tmp_path):
    # An invalid package.xml silently makes it plain python, and ros2 run no longer finds it.
    listed = subprocess.run(
        ["colcon", "--log-base", str(tmp_path), "list"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert "monoforce_ros\t.\t(ros.ament_python)" in listed


def test_every_part_of_the_package_is_installed():
    site = next(INSTALLED.glob("lib/python3*/site-packages/monoforce_ros"))
    parts = {path.relative_to(ROOT / "monoforce_ros") for path in (ROOT / "monoforce_ros").rglob("*.py")}
    assert parts == {path.relative_to(site) for path in site.rglob("*.py")}
    share = INSTALLED / "share" / "monoforce_ros"
    for folder in ("config", "launch", "msg_defs", "bags"):
        expected = {path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if path.is_file()}
        expected = {path for path in expected if "__pycache__" not in path.parts}
        assert expected <= {path.relative_to(share) for path in share.rglob("*") if path.is_file()}
    assert (share / "package.xml").is_file()
    assert (INSTALLED / "share" / "ament_index" / "resource_index" / "packages" / "monoforce_ros").is_file()


@pytest.mark.parametrize("name", EXECUTABLES)
def test_executables_are_found_by_ros2_run_and_have_a_help(executables, name):
    shown = subprocess.run([str(executables / name), "--help"], capture_output=True, text=True, timeout=60)
    assert shown.returncode == 0
    assert "usage:" in shown.stdout.lower()


def test_the_licence_and_the_dependencies_are_stated():
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.findtext("license") == "Apache-2.0"
    assert "Apache License" in (ROOT / "LICENSE").read_text()
    depends = {entry.text for entry in package.findall("exec_depend")}
    imported = {
        line.split()[1].split(".")[0]
        for path in (ROOT / "monoforce_ros").rglob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith(("from ", "import "))
    }
    ros = {name for name in imported if name.endswith(("_msgs", "_interfaces")) or name == "rclpy"}
    assert ros <= depends
    # Dependencies outside ROS are installed by rosdep or pip, and must be listed for one of them.
    named = {name.removeprefix("python3-") for name in depends} | set(re.findall(r'"([a-z-]+)>=', SETUP))
    others = {"cv2": "opencv", "yaml": "yaml", "warp": "warp-lang", "mpl_toolkits": "matplotlib"}
    third = {others.get(name, name) for name in imported - set(sys.stdlib_module_names) - ros - {"monoforce_ros"}}
    assert third - {"tf2_ros", "ament_index_python"} <= named


def test_only_nodes_and_messages_import_rclpy():
    importing = {
        path.relative_to(ROOT / "monoforce_ros").parts[0]
        for path in (ROOT / "monoforce_ros").rglob("*.py")
        if "rclpy" in path.read_text()
    }
    assert importing <= {"nodes", "messages"}


def parameter_table() -> list[str]:
    rows = ["| parameter | default | range | meaning |", "|---|---|---|---|"]
    for entry in read_schema(ROOT / "config" / "predictor.schema.yaml"):
        unit = f" {entry.unit}" if entry.unit else ""
        default = ", ".join(map(str, entry.default)) if isinstance(entry.default, list) else entry.default
        default = str(default).lower() if isinstance(default, bool) else default
        shown = f"`{default}`{unit}" if default not in ("", None) else "–"
        choices = entry.range_text.replace("|", "\\|")
        live = " ↻" if entry.dynamic else ""
        rows.append(f"| `{entry.name}`{live} | {shown} | {choices}{unit if choices else ''} | {entry.description} |")
    return rows


def test_the_readme_lists_every_parameter_as_the_file_describes_it():
    readme = (ROOT / "README.md").read_text()
    missing = [row for row in parameter_table() if row not in readme]
    assert not missing, "put these rows into README.md:\n" + "\n".join(parameter_table())


@pytest.mark.parametrize(
    "document", ["README.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md"))]
)
def test_documents_point_to_files_that_exist(document):
    text = (ROOT / document).read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if "://" not in target:
            assert ((ROOT / document).parent / target).exists(), target


def test_the_bundled_bag_is_small():
    size = sum(path.stat().st_size for path in (ROOT / "bags" / "demo").iterdir())
    assert 1e6 < size < 6e6


def test_the_set_up_finds_a_real_python_past_a_shim_that_does_not_answer(tmp_path):
    shim = tmp_path / "python3.12"
    shim.write_text("#!/bin/sh\necho 'pyenv: python3.12: command not found' >&2\nexit 127\n")
    shim.chmod(0o755)
    script = (ROOT / "scripts" / "set_up.sh").read_text().split("environment() {")[0]
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "HOME": str(tmp_path), "MONOFORCE_PYTHON": str(shim)}
    source = str(ROOT / "scripts" / "set_up.sh")
    found = subprocess.run(
        ["bash", "-c", script + "\nfind_python || echo none", source],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    ).stdout.strip()
    assert found != str(shim)
    if found != "none":
        assert Path(found).exists()


def test_the_set_up_says_what_to_install_where_there_is_no_python(tmp_path):
    script = (ROOT / "scripts" / "set_up.sh").read_text()
    (tmp_path / "scripts").mkdir()
    # The same script where no candidate answers.
    (tmp_path / "scripts" / "set_up.sh").write_text(
        script.replace("is_python_312() {\n", "is_python_312() {\n  return 1\n")
    )
    shutil.copy(ROOT / "scripts" / "environment.sh", tmp_path / "scripts")
    (tmp_path / "requirements.lock").write_text("uv==0\n")
    # The tests themselves may run in the environment of the lowest versions.
    environment = {name: value for name, value in os.environ.items() if name != "MONOFORCE_ENVIRONMENT"}
    ended = subprocess.run(
        ["bash", str(tmp_path / "scripts" / "set_up.sh"), "environment"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ended.returncode == 1
    assert "No working Python 3.12" in ended.stderr and "apt install python3.12" in ended.stderr
