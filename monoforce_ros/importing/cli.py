"""``import_robot``: make a robot file from a URDF, list what was guessed, draw the robot and check it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from monoforce_ros.core import OptionParser, atomic_path, write_text
from monoforce_ros.robots import (
    Conversion,
    ConversionOptions,
    RobotFileError,
    UrdfError,
    convert_description,
    load_robot,
    read_description,
)


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = OptionParser(
        prog="import_robot",
        description="Make a robot file from a URDF: masses, wheels, tracks, flippers, steering, hull and sensors. It "
        "lists what it guesses, draws the robot, and checks that it stands still, drives straight and turns.",
        epilog="Exit status: 0 the file is written and all checks pass, 1 a check fails, 2 the URDF cannot be used.",
    )
    parser.add_argument("urdf", type=Path, metavar="ROBOT.urdf", help="URDF, or xacro where xacro is installed")
    parser.add_argument("--out", type=Path, metavar="FILE.yaml", help="robot file (NAME.yaml in this folder)")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the robot (beside the robot file)")
    parser.add_argument("--no-picture", action="store_true", help="do not draw the robot")
    parser.add_argument("--name", help="name of the robot (that of the URDF)")
    parser.add_argument("--base-frame", metavar="LINK", help="frame with x forward and z up (base_link, or the root)")
    parser.add_argument(
        "--forward", default="x", metavar="AXIS", help="direction of travel in that frame: x, y, =-x, =-y (x)"
    )
    parser.add_argument(
        "--drive", metavar="KIND", help="skid, differential, ackermann, four_wheel_steering, independent"
    )
    parser.add_argument("--maximum-speed", type=float, metavar="M/S", help="(from the wheel joints' velocity limits)")
    parser.add_argument("--maximum-yaw-rate", type=float, metavar="RAD/S", help="(not limited)")
    parser.add_argument("--track", action="append", default=[], metavar="LINK", help="this link is a track; repeatable")
    parser.add_argument("--flipper", action="append", default=[], metavar="LINK", help="a flipper; repeatable")
    parser.add_argument(
        "--hint",
        action="append",
        default=[],
        metavar="NAME=KIND",
        help="what a link or joint is: wheel, free_wheel, steering, caster, rocker, track, flipper, fixed (does not "
        "move) or ignore (not part of the robot); repeatable",
    )
    parser.add_argument(
        "--package", action="append", default=[], metavar="NAME=FOLDER", help="where package://NAME is; repeatable"
    )
    parser.add_argument("--ignore-meshes", action="store_true", help="leave out all meshes")
    parser.add_argument(
        "--xacro", action="append", default=[], metavar="NAME:=VALUE", help="argument for xacro; repeatable"
    )
    parser.add_argument("--force", action="store_true", help="overwrite existing files")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    try:
        description = read_description(
            options.urdf,
            packages={
                name: Path(folder) for name, folder in _pairs(options.package, "--package", "NAME=FOLDER").items()
            },
            ignore_meshes=options.ignore_meshes,
            xacro_arguments=options.xacro,
        )
        hints = _pairs(options.hint, "--hint", "NAME=KIND")
        hints |= dict.fromkeys(options.track, "track") | dict.fromkeys(options.flipper, "flipper")
        for name in ("maximum_speed", "maximum_yaw_rate"):
            value = getattr(options, name)
            if value is not None and not 0.01 <= value <= 1000.0:
                raise UrdfError(f"--{name.replace('_', '-')}: got {value}, expected 0.01 to 1000")
        conversion = convert_description(
            description,
            ConversionOptions(
                name=options.name,
                base_frame=options.base_frame,
                forward=options.forward,
                drive=options.drive,
                maximum_speed=options.maximum_speed,
                maximum_yaw_rate=options.maximum_yaw_rate,
                hints=hints,
            ),
        )
        out = options.out or Path(f"{conversion.content['name']}.yaml")
        picture = None if options.no_picture else (options.picture or out.with_suffix(".png"))
        for path in (out, picture):
            if path is not None and path.exists() and not options.force:
                raise UrdfError(f"{path} exists; choose another file (--out, --picture) or overwrite it (--force)")
        out.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(out) as unfinished:
            # Loaded before it gets its name: a file that cannot be read is not left behind.
            checked = unfinished.with_suffix(".yaml")
            try:
                write_text(checked, robot_file_text(conversion, options.urdf))
                load_robot(checked)
            except RobotFileError as error:
                checked.unlink(missing_ok=True)
                raise RobotFileError(
                    f"{options.urdf}: not a valid robot: {error}".replace(f"{checked}: ", "")
                ) from error
            except BaseException:
                checked.unlink(missing_ok=True)
                raise
            checked.replace(unfinished)
        return _report(conversion, out, picture)
    except (UrdfError, RobotFileError) as error:
        print(f"import_robot: {error}", file=sys.stderr)
        return 2


def _report(conversion: Conversion, out: Path, picture: Path | None) -> int:
    """Load what was written, draw and check it, and print everything; returns the exit status."""
    from monoforce_ros.importing.check import check_robot
    from monoforce_ros.importing.picture import draw_robot
    from monoforce_ros.reporting import figure_png

    print("Guessed:")
    for line in conversion.guesses:
        print(f"  {line}")
    for line in conversion.warnings:
        print(f"Warning: {line}")
    robot = load_robot(out)
    print(f"Written: {out} ({len(robot.points)} body points)")
    if picture is not None:
        picture.parent.mkdir(parents=True, exist_ok=True)
        image = figure_png(draw_robot(robot, conversion.content))
        with atomic_path(picture) as unfinished:
            unfinished.write_bytes(image)
        print(f"Drawn: {picture}")
    content = conversion.content
    kind = content.get("drive", {}).get("kind", "skid")
    along = [wheel["centre"][0] for wheel in content.get("wheels", [])]
    findings = check_robot(
        robot,
        turns_on_the_spot=kind in ("skid", "differential"),
        wheelbase=max(along) - min(along) if along else 1.0,
    )
    print("Checked on level ground:")
    for finding in findings:
        print(f"  {'passed' if finding.passed else 'FAILED'}  {finding.name}: {finding.text}")
    failed = [finding.name for finding in findings if not finding.passed]
    if failed:
        print(f"{len(failed)} of {len(findings)} checks failed; correct the guesses (--hint) or edit {out}")
    return 1 if failed else 0


def robot_file_text(conversion: Conversion, source: Path) -> str:
    """The robot file, with what was guessed as comments at its top."""
    head = [
        f"# Imported from {source.name} by import_robot. Lengths in metres, masses in kilograms, angles in radians."
    ]
    head += ["# Guessed, to be checked:", *(f"#   {line}" for line in conversion.guesses)]
    head += [f"# Warning: {line}" for line in conversion.warnings]
    # Names come from the file and may contain anything.
    head = [" ".join(line.split()) if "\n" in line or "\r" in line else line for line in head]
    sections = []
    for key, value in conversion.content.items():
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            sections += [f"{key}:", *(f"  - {_inline(entry)}" for entry in value)]
        elif key == "sensors":
            sections += [f"{key}:", *(f"  {_inline(name)}: {_inline(entry)}" for name, entry in value.items())]
        else:
            sections.append(f"{key}: {_inline(value)}")
    return "\n".join([*head, *sections]) + "\n"


def _inline(value: Any) -> str:
    """A value as YAML on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, allow_unicode=True, width=100_000)
    return text.removesuffix("\n").removesuffix("\n...")


def _pairs(given: Sequence[str], option: str, form: str) -> dict[str, str]:
    found = {}
    for text in given:
        name, separator, value = text.partition("=")
        if not (separator and name and value):
            raise UrdfError(f"{option} {text!r}: expected {form}")
        found[name] = value
    return found


if __name__ == "__main__":
    sys.exit(main())
