"""``convert``: folders and files of public datasets into bags."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from monoforce_ros.bags import Recording
from monoforce_ros.datasets.dataset import DatasetError
from monoforce_ros.datasets.drive import DriveRecording, drive_to_bag
from monoforce_ros.datasets.rellis import LIDAR_FRAME, RellisSequence, sequence_to_bag
from monoforce_ros.datasets.rough import RoughScene, scene_to_bag
from monoforce_ros.robots import RobotFileError, load_robot


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = argparse.ArgumentParser(
        prog="convert",
        description="Write a public dataset's folder or file as a rosbag2 bag. What in the bag is not a measurement is "
        "printed, and said in the bag's topic /about.",
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    rough = kinds.add_parser("rough", help="a scene of ROUGH / RobinGas: images, calibration, cloud, poses")
    rough.add_argument("--twist", nargs=2, type=float, default=(0.5, 0.0), metavar=("M/S", "RAD/S"), help="commands")
    rough.add_argument("--seconds", type=float, default=10.0, help="of odometry after the cloud (%(default)s)")
    rellis = kinds.add_parser("rellis", help="a sequence of RELLIS-3D: images, clouds, poses")
    rellis.add_argument("--first", type=int, default=0, metavar="FRAME", help="(%(default)s)")
    rellis.add_argument("--count", type=int, metavar="FRAMES", help="(all)")
    rellis.add_argument("--robot", default="warthog", help="whose lidar pose to take (%(default)s)")
    drive = kinds.add_parser("drive", help="windows (.npz) or a log (.csv.gz) of DRIVE: commands, poses, wheels, gyro")
    drive.add_argument("--correct-delay", action="store_true", help="stamp the late poses as early as the gyro says")
    for kind in (rough, rellis, drive):
        kind.add_argument("source", type=Path, help="folder or file of the dataset")
        kind.add_argument("out", type=Path, help="folder of the bag")
        kind.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="(%(default)s)")
        kind.add_argument("--force", action="store_true", help="replace OUT if it exists")
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
            recording = DriveRecording.open(options.source)
            remarks = drive_to_bag(recording, options.out, correct_delay=options.correct_delay, **writing)
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
