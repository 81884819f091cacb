"""docs/first_drive.md: its commands exist with their options, and those that are cheap run as they are written."""

import re
import shlex
import subprocess

import pytest
from conftest import ROOT

from monoforce_ros.nodes.launch_plan import launch_arguments

PAGE = ROOT / "docs" / "first_drive.md"


def commands() -> list[list[str]]:
    """Commands of the page, without what the shell would expand."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)
    text = "\n".join(blocks).replace("\\\n", " ")
    text = re.sub(r"\$\(ros2 pkg prefix --share monoforce_ros\)", str(ROOT), text).replace("$PWD/", "")
    return [shlex.split(line, comments=True) for line in text.splitlines() if line.strip()]


def of_the_package() -> list[list[str]]:
    """Executable and arguments of every ``ros2 run monoforce_ros``."""
    return [words[3:] for words in commands() if words[:3] == ["ros2", "run", "monoforce_ros"]]


def test_the_page_leads_through_every_tool():
    assert {"simulator", "synthesize", "evaluate", "diagnose", "train"} <= {words[0] for words in of_the_package()}


def test_options_of_the_page_exist(executables):
    helps: dict[str, str] = {}
    for name, *arguments in of_the_package():
        if name not in helps:
            shown = subprocess.run([str(executables / name), "--help"], capture_output=True, text=True, timeout=120)
            helps[name] = shown.stdout
        for argument in arguments:
            if argument.startswith("--"):
                assert re.search(rf"{re.escape(argument)}\b", helps[name]), f"{name} has no {argument}"


def test_launch_arguments_of_the_page_exist():
    known = {argument.name for argument in launch_arguments()}
    launched = [words for words in commands() if words[:3] == ["ros2", "launch", "monoforce_ros"]]
    assert len(launched) >= 3
    for words in launched:
        assert (ROOT / "launch" / words[3]).is_file()
        assert {word.split(":=")[0] for word in words[4:]} <= known, words


def test_files_of_the_page_exist():
    named = [word for words in commands() for word in words if word.startswith(str(ROOT))]
    assert len(named) >= 2
    for word in named:
        assert (ROOT / word).is_file(), word


@pytest.mark.unhurried
def test_recording_and_checking_run_as_written(executables, tmp_path):
    """Shorter, and without a camera, which needs a renderer; the rest of each command is the page's."""
    ran = set()
    for name, *arguments in of_the_package():
        checks = name == "evaluate" and ("--check" in arguments or ("--terrain" in arguments and "lidar" in arguments))
        if name != "synthesize" and not checks:
            continue
        for option, value in (("--duration", "8"), ("--count", "1")):
            if option in arguments:
                arguments[arguments.index(option) + 1] = value
        if "--camera-rate" in arguments:
            arguments += ["--camera", "none"]
        # The page's seed 31 becomes the folder drives/0031 where several are recorded.
        if "--count" in arguments:
            index = arguments.index("--count")
            del arguments[index : index + 2]
            arguments[arguments.index("drives")] = "drives/0031"
        ended = subprocess.run(
            [str(executables / name), *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=280
        )
        assert ended.returncode == 0, f"{name} {arguments}\n{ended.stdout}\n{ended.stderr}"
        ran.add((name, "--check" in arguments))
    assert ran == {("synthesize", False), ("evaluate", True), ("evaluate", False)}
    assert (tmp_path / "report" / "lidar" / "report.html").is_file()
