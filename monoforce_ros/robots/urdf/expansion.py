"""Expansion: the URDF text that xacro makes of a macro file."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from monoforce_ros.robots.urdf.errors import UrdfError
from monoforce_ros.robots.urdf.shapes import package_folders

_TIMEOUT = 60.0
"""Of one run of xacro [s]."""
_MAXIMUM_PACKAGES = 20
"""Packages that are looked for beside the file."""
_UNKNOWN_PACKAGE = re.compile(r"package '([\w.-]+)' not found")


def expand(path: Path, arguments: Sequence[str], packages: Mapping[str, Path]) -> str:
    """Run xacro on a file.

    Args:
        path: the macro file.
        arguments: ``name:=value`` arguments.
        packages: folders that ``$(find NAME)`` gives. Packages that are neither here nor in a sourced workspace are
            looked for beside the file and its parents.

    Raises:
        UrdfError: xacro is not installed, an argument has another form, or xacro fails.
    """
    program = shutil.which("xacro")
    if program is None:
        raise UrdfError(
            f"{path}: is a xacro file, and xacro is not installed: install ros-jazzy-xacro (apt) or xacro (pip), or "
            "expand it elsewhere (xacro FILE > robot.urdf)"
        )
    bad = [argument for argument in arguments if ":=" not in argument]
    if bad:
        raise UrdfError(f"xacro argument {bad[0]!r}: expected name:=value")
    known = dict(packages)
    while True:
        done = _run([program, str(path), *arguments], path, known)
        if not done.returncode:
            return done.stdout
        unknown = _UNKNOWN_PACKAGE.search(done.stderr)
        if unknown is None:
            raise UrdfError(f"{path}: xacro failed: {_shortened(done.stderr)}")
        name = unknown.group(1)
        folder = next((found for found in package_folders(name, path, {}) if found.is_dir()), None)
        if name in known or folder is None or len(known) >= len(packages) + _MAXIMUM_PACKAGES:
            raise UrdfError(
                f"{path}: xacro needs the package {name}, which is not found; name its folder (--package "
                f"{name}=FOLDER) or source the workspace that has it"
            )
        known[name] = folder


def _run(command: Sequence[str], path: Path, packages: Mapping[str, Path]) -> subprocess.CompletedProcess[str]:
    """Run xacro where the given packages are found before those of the environment."""
    with tempfile.TemporaryDirectory(prefix="import_robot_") as prefix:
        index = Path(prefix) / "share" / "ament_index" / "resource_index" / "packages"
        index.mkdir(parents=True)
        for name, folder in packages.items():
            (index / name).touch()
            (Path(prefix) / "share" / name).symlink_to(Path(folder).expanduser().resolve())
        prefixes = [prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
        environment = os.environ | {"AMENT_PREFIX_PATH": os.pathsep.join(filter(None, prefixes))}
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=_TIMEOUT, check=False, env=environment
            )
        except subprocess.TimeoutExpired as error:
            raise UrdfError(f"{path}: xacro did not end within {_TIMEOUT:g} s") from error
        # References to meshes are to remain after this folder is gone.
        text = done.stdout
        for name, folder in packages.items():
            text = text.replace(str(Path(prefix) / "share" / name), str(Path(folder).expanduser().resolve()))
        done.stdout = text
        return done


def _shortened(message: str) -> str:
    """The end of a message as one line."""
    return " ".join(message.split())[-500:]
