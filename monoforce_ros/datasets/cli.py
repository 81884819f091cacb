"""``convert``: convert public datasets to bags."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from monoforce_ros.bags import Recording
from monoforce_ros.core import OptionParser
from monoforce_ros.datasets.dataset import DatasetError
from monoforce_ros.datasets.drive import DriveRecording, drive_to_bag
from monoforce_ros.datasets.rellis import LIDAR_FRAME, RellisSequence, sequence_to_bag
from monoforce_ros.datasets.rough import RoughScene, scene_to_bag
from monoforce_ros.robots import RobotFileError, load_robot


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = OptionParser(
        prog="convert",
        description="Convert a folder or file of a public dataset to a rosbag2 bag. Data in the bag that are not "
        "measurements are listed in the output and on the bag's topic /about.",
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    rough = kinds.add_parser("rough", help="ROUGH / RobinGas scene: images, calibration, cloud, poses")
    rough.add_argument(
        "--twist", nargs=2, type=float, default=(0.5, 0.0), metavar=("M/S", "RAD/S"), help="command to write"
    )
    rough.add_argument(
        "--seconds", type=float, default=10.0, help="duration of the odometry after the cloud (%(default)s)"
    )
    rellis = kinds.add_parser("rellis", help="RELLIS-3D sequence: images, clouds, poses")
    rellis.add_argument("--first", type=int, default=0, metavar="FRAME", help="first frame (%(default)s)")
    rellis.add_argument("--count", type=int, metavar="FRAMES", help="number of frames (all)")
    rellis.add_argument("--robot", default="warthog", help="robot whose lidar pose is used (%(default)s)")
    drive = kinds.add_parser("drive", help="DRIVE windows (.npz) or log (.csv.gz): commands, poses, wheel speeds, gyro")
    drive.add_argument(
        "--correct-delay", action="store_true", help="correct the pose stamps by the delay relative to the gyro"
    )
    for kind in (rough, rellis, drive):
        kind.add_argument("source", type=Path, help="folder or file of the dataset")
        kind.add_argument("out", type=Path, help="folder of the bag")
        kind.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="(%(default)s)")
        kind.add_argument("--force", action="store_true", help="overwrite OUT if it exists")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = build_parser().parse_args(arguments)
    writing = {"storage": options.storage, "overwrite": options.force}
    try:
        if options.kind == "rough":
            scene = RoughScene.open(options.source)
            twist = (float(options.twist[0]), float(options.twist[1]))
            remarks = scene_to_bag(scene, options.out, twist=twist, seconds=options.seconds, **writing)
        elif options.kind == "rellis":
            sequence = RellisSequence.open(options.source)
            sensors = load_robot(options.robot).sensors
            lidar = sensors.get(LIDAR_FRAME, sensors.get("lidar"))
            if lidar is None:
                raise DatasetError(f"robot {options.robot}: sensors: got {sorted(sensors)}, expected one named lidar")
            stop = len(sequence) if options.count is None else options.first + options.count
            remarks = sequence_to_bag(
                sequence, options.out, base_from_lidar=lidar.double().numpy(), frames=range(options.first, stop),
                **writing,
            )  # fmt: skip
        else:
            source = DriveRecording.open(options.source)
            remarks = drive_to_bag(source, options.out, correct_delay=options.correct_delay, **writing)
    except (DatasetError, RobotFileError, ValueError, OSError) as error:
        print(f"convert: {error}", file=sys.stderr)
        return 1
    recording = Recording.open(options.out)
    span = (int(recording.motion.stamps[-1]) - int(recording.motion.stamps[0])) * 1e-9
    images = sum(len(frames) for frames in recording.images.values())
    print(
        f"{options.out}: {span:.1f} s, {len(recording.motion)} poses, {len(recording.commands)} commands, "
        f"{len(recording.clouds)} clouds, {images} images"
    )
    for remark in remarks:
        print(f"  note: {remark}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
