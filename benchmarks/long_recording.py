"""Time of a diagnosis of a long recording: a recorded drive that is repeated up to the wanted length.

    scripts/run.sh python benchmarks/long_recording.py BAG [--length 1380] [--robot husky] [--out DIR]

Each repetition begins where the last one ended, one second later: odometry has a pause there, as where a robot is set
down between drives. Commands, poses and wheel speeds are kept, other sensors are not. `diagnose` runs with one job; its
processor time does not depend on what else the computer does.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, Recording, builders

PAUSE = 1_000_000_000
"""Between two repetitions [ns]."""
WHEELS = ("front_left_wheel", "front_right_wheel")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--length", type=float, default=1380.0, help="of the recording [s] (%(default)s)")
    parser.add_argument("--robot", default="husky", help="(%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/long_recording"), help="(%(default)s)")
    options = parser.parse_args()
    repeated = options.out / "bag"
    if not repeated.exists():
        repeat(options.bag, options.length, repeated)
    began = time.monotonic()
    command = ["diagnose", str(repeated), "--robot", options.robot, "--jobs", "1", "--quiet"]
    done = subprocess.run(["scripts/run.sh", *command, "--out", str(options.out / "report")], check=False)
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    report = json.loads((options.out / "report" / "report.json").read_text())
    print(
        f"{report['inputs']['recording_s']} s, {report['inputs']['driven_m']} m driven, {report['verdict']}: "
        f"{usage.ru_utime + usage.ru_stime:.0f} s of a processor, {time.monotonic() - began:.0f} s"
    )
    return done.returncode


def repeat(bag: Path, length: float, out: Path) -> None:
    """Write a recording that repeats the drive of a bag up to a length [s]."""
    recording = Recording.open(bag)
    motion, commands, wheels = recording.motion, recording.commands, recording.wheels
    poses = np.tile(np.eye(4), (len(motion), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(motion.quaternions).as_matrix()
    poses[:, :3, 3] = motion.positions
    period = int(motion.stamps[-1] - motion.stamps[0]) + PAUSE
    end = int(motion.stamps[0]) + round(length * 1e9)
    start, shift = np.eye(4), 0
    with BagWriter(out) as writer:
        while motion.stamps[0] + shift < end:
            rows: list[tuple[int, str, object]] = []
            for stamp, pose, linear, angular in zip(
                motion.stamps + shift, start @ poses, motion.linear_velocities, motion.angular_velocities, strict=True
            ):
                quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
                message = builders.odometry(int(stamp), "odom", "base_link", pose[:3, 3], quaternion, linear, angular)
                rows.append((int(stamp), "/odom", message))
            for stamp, twist in zip(commands.stamps + shift, commands.twists, strict=True):
                rows.append((int(stamp), "/cmd_vel", builders.twist_stamped(int(stamp), "base_link", *twist)))
            if wheels is not None:
                for stamp, speeds in zip(wheels.stamps + shift, wheels.speeds, strict=True):
                    rows.append((int(stamp), "/joint_states", builders.joint_state(int(stamp), WHEELS, [0, 0], speeds)))
            for stamp, topic, message in sorted(rows, key=lambda row: row[0]):
                if stamp < end:
                    writer.write(topic, message, stamp)
            start = start @ poses[-1] @ np.linalg.inv(poses[0])
            shift += period


if __name__ == "__main__":
    sys.exit(main())
