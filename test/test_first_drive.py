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
    assert named
    for word in named:
        assert (ROOT / word).is_file(), word


@pytest.mark.unhurried
@pytest.mark.timeout(600)
def test_recording_checking_and_evaluating_run_as_written(executables, tmp_path):
    """Shorter, one recording, and without a camera, which needs a renderer; the rest of each command is the page's."""
    ran = []
    for name, *arguments in of_the_package():
        if name == "synthesize" and "drives" in arguments:
            # Several recordings go to folders of their seeds.
            arguments[arguments.index("drives")] = f"drives/00{arguments[arguments.index('--seed') + 1]}"
            for option in ("--count", "--camera-rate"):
                index = arguments.index(option)
                del arguments[index : index + 2]
            arguments[arguments.index("--duration") + 1] = "8"
            arguments += ["--camera", "none"]
        elif name != "evaluate" or "drives/0031" not in arguments:
            continue
        ended = subprocess.run(
            [str(executables / name), *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=280
        )
        assert ended.returncode == 0, f"{name} {arguments}\n{ended.stdout}\n{ended.stderr}"
        ran.append((name, "--check" in arguments))
        if "--check" in arguments:
            assert "usable: predictions along this bag can be evaluated" in ended.stdout
    assert ran == [("synthesize", False), ("evaluate", True), ("evaluate", False)]
    assert (tmp_path / "report" / "lidar" / "report.html").is_file()
