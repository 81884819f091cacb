"""Latency from sensor to published path, rate, CPU and memory of the installed predictor, measured across processes.

    scripts/run.sh python benchmarks/node.py [--seconds 20] [--only NAME ...] [--json FILE] [--docs FILE]

A process publishes raw images or clouds at 10 Hz, odometry at 50 Hz and commands at 20 Hz like a robot's drivers,
stamped with the time of publication. Latency is the time from a stamp to the arrival of the path with that stamp.
`overload` sends images at ten times the rate: latency must not grow, and dropped inputs are counted. `--endurance
MINUTES` instead plays the demo bag in a loop at twice its speed and reports memory and threads over time.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from rclpy.qos import QoSProfile
from ros_peer import Executable, Peer

from monoforce_ros.bags import Recording, builders, type_store
from monoforce_ros.core import write_text
from monoforce_ros.messages import message_class
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import robot_file

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = {"ROS_DOMAIN_ID": "87", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
PROFILE = ROOT / "config" / "fastdds_large_messages.xml"
_TICK = os.sysconf("SC_CLK_TCK")
_SIDES = ("front", "left", "right", "rear")


@dataclass(frozen=True)
class Case:
    """Inputs and parameters of the predictor."""

    name: str
    title: str
    source: str
    """``terrain_source`` of the predictor."""
    cameras: int = 0
    clouds: bool = False
    rate: float = 10.0
    parameters: tuple[str, ...] = ()


CASES = (
    Case("lidar", "lidar", "lidar", clouds=True),
    Case("lidar_candidates", "lidar, 64 candidates", "lidar", clouds=True, parameters=("candidates:=64",)),
    Case("interpolation", "lidar, interpolated", "lidar_interpolation", clouds=True),
    Case("camera", "1 camera 640 × 480", "camera", cameras=1),
    Case("camera_candidates", "1 camera, 64 candidates", "camera", cameras=1, parameters=("candidates:=64",)),
    Case("camera_all", "1 camera, 64 candidates, ensemble of 24", "camera", cameras=1,
         parameters=("candidates:=64", "ensemble:=24")),
    Case("lidar_camera", "lidar and 1 camera", "lidar_camera", cameras=1, clouds=True),
    Case("four_cameras", "4 cameras 640 × 480", "camera", cameras=4),
    Case("overload", "1 camera at 100 Hz", "camera", cameras=1, rate=100.0),
)  # fmt: skip


def four_camera_robot(folder: Path) -> Path:
    """Robot file of a Husky with a camera on each side."""
    content = yaml.safe_load(robot_file("husky").read_text(encoding="utf-8"))
    for index, side in enumerate(_SIDES):
        turn = (0.0, np.pi / 2, -np.pi / 2, np.pi)[index]
        content["sensors"][f"camera_{side}"] = {
            "translation": [float(0.3 * np.cos(turn)), float(0.3 * np.sin(turn)), 0.55],
            "rotation": [-1.8208, 0.0, float(turn - np.pi / 2)],
        }
    file = folder / "husky_four_cameras.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


class Source(Peer):
    """Publishes sensor data like a robot's drivers and receives the path, in one thread."""

    def __init__(self, case: Case, robot_frames: list[str]):
        # Large messages need a large shared-memory segment in the publishing process.
        super().__init__("drivers", ENVIRONMENT | {"FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE)})
        self.case, self.frames = case, robot_frames
        newest = QoSProfile(depth=10)
        self.latencies: list[float] = []
        self.arrivals: list[float] = []
        self.candidate_latencies: list[float] = []
        self.dropped = 0
        self.diagnostics: dict[str, str] = {}
        self.node.create_subscription(
            message_class("nav_msgs/msg/Path"), "predicted/path", self._on_path, newest, raw=True
        )
        self.node.create_subscription(
            message_class("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", self._on_diagnostics, newest
        )
        self.node.create_subscription(
            message_class("sensor_msgs/msg/PointCloud2"), "predicted/candidate_costs", self._on_costs, newest, raw=True
        )
        self._publishers = {}
        recording = Recording.open(ROOT / "bags" / "demo")
        topic = next(iter(recording.images))
        image = cv2.resize(recording.image(recording.images[topic][20]), (640, 480))
        camera = recording.cameras[topic]
        scale = 640 / camera.width
        matrix = camera.matrix * np.array([[scale], [scale], [1.0]])
        # Consecutive encoded images differ only in their stamps.
        self.images = [self._encode(builders.image(1, frame, image)) for frame in robot_frames]
        self.infos = [
            builders.camera_info(1, frame, 640, 480, matrix, camera.distortion, camera.distortion_model)
            for frame in robot_frames
        ]
        points, frame = recording.cloud(recording.clouds[10])
        self.cloud = self._encode(builders.point_cloud(1, frame, points.astype(np.float32)))

    @staticmethod
    def _encode(message) -> bytearray:
        return bytearray(type_store().serialize_cdr(message, message.__msgtype__))

    def _publish(self, topic: str, kind: str, data: bytes) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(message_class(kind), topic, QoSProfile(depth=2))
        self._publishers[topic].publish(bytes(data))

    def _stamped(self, data: bytearray, stamp: int) -> bytes:
        data[4:12] = np.array([stamp // 10**9, stamp % 10**9], "<u4").tobytes()
        return data

    def _on_path(self, data: bytes) -> None:
        self.latencies.append(self._age(data))
        self.arrivals.append(time.monotonic())

    def _on_costs(self, data: bytes) -> None:
        self.candidate_latencies.append(self._age(data))

    @staticmethod
    def _age(data: bytes) -> float:
        """Time since the stamp of an encoded message [ms]."""
        seconds, nanoseconds = np.frombuffer(data[4:12], "<u4")
        return (time.time_ns() - (int(seconds) * 10**9 + int(nanoseconds))) * 1e-6

    def _on_diagnostics(self, message) -> None:
        for status in message.status:
            self.diagnostics[status.name] = status.message
            for entry in status.values:
                if entry.key == "dropped inputs":
                    self.dropped = int(entry.value)

    def run(self, seconds: float) -> int:
        """Publish for ``seconds``; returns the number of images or clouds sent."""
        begin, sent, small = time.monotonic(), 0, 0
        while (now := time.monotonic() - begin) < seconds:
            if now * 50 >= small:
                stamp = time.time_ns()
                pose = [0.3 * now % 2, 0.0, 0.1323]
                odometry = builders.odometry(stamp, "odom", "base_link", pose, [0, 0, 0, 1], [0.3, 0, 0], [0, 0, 0])
                self._publish("odom", "nav_msgs/msg/Odometry", self._encode(odometry))
                if small % 5 < 2:
                    command = builders.twist_stamped(stamp, "base_link", 0.5, 0.1)
                    self._publish("cmd_vel", "geometry_msgs/msg/TwistStamped", self._encode(command))
                if small % 50 == 0:
                    for frame, info in zip(self.frames, self.infos, strict=True):
                        self._publish(f"{frame}/camera_info", "sensor_msgs/msg/CameraInfo", self._encode(info))
                small += 1
            if now * self.case.rate >= sent:
                stamp = time.time_ns()
                for frame, image in zip(self.frames, self.images, strict=True):
                    self._publish(f"{frame}/image_raw", "sensor_msgs/msg/Image", self._stamped(image, stamp))
                if self.case.clouds:
                    self._publish("points", "sensor_msgs/msg/PointCloud2", self._stamped(self.cloud, stamp))
                sent += 1
            self.spin_once(0.002)
        return sent


class Predictor(Executable):
    """The installed predictor with the parameters of a case."""

    def __init__(self, case: Case, folder: Path, frames: list[str]):
        parameters = [f"terrain_source:={case.source}", f"robot:={four_camera_robot(folder)}", *case.parameters]
        if frames:
            parameters.append(f"image_topics:=[{','.join(f'{frame}/image_raw' for frame in frames)}]")
        arguments = ["--ros-args", *(word for p in parameters for word in ("-p", p))]
        super().__init__("predictor", arguments, folder / f"{case.name}.log", ENVIRONMENT)
        self.wait_for("predicting")

    def cpu_seconds(self) -> float:
        """CPU time used so far [s]."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICK

    def state(self) -> tuple[float, int]:
        """Resident memory [MB] and number of threads."""
        values = dict(line.split(":", 1) for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines())
        return int(values["VmRSS"].split()[0]) / 1024, int(values["Threads"])


def measure(case: Case, seconds: float, folder: Path) -> dict:
    """Run one case."""
    frames = [f"camera_{side}" for side in _SIDES[: case.cameras]]
    predictor = Predictor(case, folder, frames)
    source = Source(case, frames)
    source.run(4.0)
    if not source.latencies:
        sys.exit(f"{case.name}: no path received; diagnostics: {source.diagnostics}")
    source.latencies.clear()
    source.arrivals.clear()
    source.candidate_latencies.clear()
    dropped, cpu, began = source.dropped, predictor.cpu_seconds(), time.monotonic()
    sent = source.run(seconds)
    duration = time.monotonic() - began
    used = (predictor.cpu_seconds() - cpu) / duration
    memory, threads = predictor.state()
    source.spin_once(1.2)
    values = np.array(source.latencies)
    gaps = np.diff(source.arrivals)
    row = {
        "case": case.name, "title": case.title, "sent_hz": sent / duration, "paths": len(values),
        "rate_hz": len(values) / duration, "longest_gap_s": float(gaps.max()) if len(gaps) else None,
        **{f"p{q}_ms": float(np.percentile(values, q)) for q in (50, 95, 99)},
        "candidates_hz": len(source.candidate_latencies) / duration,
        "candidates_p95_ms": (
            float(np.percentile(source.candidate_latencies, 95)) if source.candidate_latencies else None
        ),
        "cpu_cores": used, "memory_mb": memory, "threads": threads, "dropped": source.dropped - dropped,
    }  # fmt: skip
    source.close()
    row["exit_status"] = predictor.stop()
    return row


class Listener(Peer):
    """Counts paths."""

    def __init__(self):
        super().__init__("listener", ENVIRONMENT)
        self.count = 0
        path = message_class("nav_msgs/msg/Path")
        self.node.create_subscription(path, "predicted/path", self._on_path, QoSProfile(depth=10), raw=True)

    def _on_path(self, _: bytes) -> None:
        self.count += 1

    def run(self, seconds: float) -> int:
        """Receive for ``seconds``; returns the number of paths."""
        before = self.count
        self.spin(seconds)
        return self.count - before


def endure(case: Case, minutes: float, folder: Path) -> dict:
    """Play the demo bag in a loop at twice its speed; samples memory and threads ten times."""
    predictor = Predictor(case, folder, [])
    arguments = [str(ROOT / "bags" / "demo"), "--loop", "--rate", "2"]
    player = Executable("bag_player", arguments, folder / "bag_player.log", ENVIRONMENT)
    listener = Listener()
    samples = []
    try:
        # Libraries, kernels and caches allocate memory in the first seconds; this is not a leak.
        listener.run(12.0)
        for part in range(10):
            paths = listener.run(6.0 * minutes)
            memory, threads = predictor.state()
            samples.append(
                {"minute": (part + 1) * minutes / 10, "memory_mb": memory, "threads": threads, "paths": paths}
            )
            print(f"  {samples[-1]['minute']:.1f} min: {memory:.0f} MB, {threads} threads, {paths} paths", flush=True)
    finally:
        listener.close()
        player_status = player.stop()
        status = predictor.stop()
    return {"case": case.name, "minutes": minutes, "samples": samples, "exit_status": [status, player_status]}


def endurance_table(found: dict) -> str:
    """Markdown table."""
    lines = ["| minute | memory | threads | paths |", "|---|---|---|---|"]
    lines += [
        f"| {s['minute']:.1f} | {s['memory_mb']:.0f} MB | {s['threads']} | {s['paths']} |" for s in found["samples"]
    ]
    lines += ["", f"Exit statuses of predictor and player: {' and '.join(map(str, found['exit_status']))}."]
    return "\n".join(lines)


def _candidates(row: dict) -> str:
    """Rate and latency of the candidate costs."""
    return f"{row['candidates_hz']:.1f} Hz, {row['candidates_p95_ms']:.0f} ms" if row["candidates_p95_ms"] else "–"


def table(rows: list[dict]) -> str:
    """Markdown table."""
    lines = [
        "| input | sent | paths | p50 | p95 | p99 | candidates, p95 | CPU | memory | dropped |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['title']} | {row['sent_hz']:.0f} Hz | {row['rate_hz']:.1f} Hz | {row['p50_ms']:.0f} ms | "
        f"{row['p95_ms']:.0f} ms | {row['p99_ms']:.0f} ms | {_candidates(row)} | {100 * row['cpu_cores']:.0f} % | "
        f"{row['memory_mb']:.0f} MB | {row['dropped']} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each case (%(default)s)")
    parser.add_argument(
        "--only", nargs="+", choices=[case.name for case in CASES], metavar="NAME", help="run only these cases"
    )
    parser.add_argument(
        "--endurance",
        type=float,
        metavar="MINUTES",
        help="play the bag in a loop at double speed for this long instead, with 8 candidates and an ensemble of 8; "
        "uses the sensors of the first case of --only (default: one camera)",
    )
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument(
        "--docs", type=Path, help="write the table between the `<!-- latency -->` comments of this document"
    )
    options = parser.parse_args()
    cases = [case for case in CASES if not options.only or case.name in options.only]
    with tempfile.TemporaryDirectory() as folder:
        if options.endurance:
            source = cases[0] if options.only else next(case for case in CASES if case.name == "camera")
            case = replace(source, name="endurance", parameters=("candidates:=8", "ensemble:=8"))
            found = endure(case, options.endurance, Path(folder))
            result = {"endurance": found}
            if options.docs:
                write_between(options.docs, "endurance", endurance_table(found))
        else:
            rows = []
            for case in cases:
                rows.append(measure(case, options.seconds, Path(folder)))
                row = rows[-1]
                print(
                    f"{case.title}: {row['rate_hz']:.1f} Hz, p50 {row['p50_ms']:.0f}, p95 {row['p95_ms']:.0f}, p99 "
                    f"{row['p99_ms']:.0f} ms, candidates {_candidates(row)}, {100 * row['cpu_cores']:.0f} % CPU, "
                    f"{row['memory_mb']:.0f} MB, {row['dropped']} dropped",
                    flush=True,
                )
            result = {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "rows": rows}
            if options.docs:
                write_between(options.docs, "latency", table(rows))
    if options.json:
        write_text(options.json, json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
