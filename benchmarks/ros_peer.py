"""Helpers for benchmarks and tests: a ROS peer node, and installed executables as processes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor

_INSTALL = Path(os.environ.get("MONOFORCE_INSTALL", Path(__file__).resolve().parent.parent / "install"))
INSTALLED = _INSTALL / "monoforce_ros" / "lib" / "monoforce_ros"


class Peer:
    """A node that publishes and subscribes in the thread that spins it.

    Args:
        name: name of the node.
        environment: ``ROS_DOMAIN_ID``, and environment variables for the middleware.
    """

    def __init__(self, name: str, environment: Mapping[str, str]):
        # Pass the domain to the context, because a process may have peers in several domains.
        os.environ.update({key: value for key, value in environment.items() if key != "ROS_DOMAIN_ID"})
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        self.node = rclpy.create_node(name, context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def spin_once(self, seconds: float) -> None:
        """Handle one message, or return after ``seconds``."""
        self._executor.spin_once(timeout_sec=seconds)

    def spin(self, seconds: float) -> None:
        """Handle messages for ``seconds``."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.spin_once(left)

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class Executable:
    """An installed executable of the package, running as a process with its output in a file.

    Args:
        name: name of the executable.
        arguments: command-line arguments.
        log: file for its output.
        environment: variables added to this process's environment.
    """

    def __init__(self, name: str, arguments: list[str], log: Path, environment: Mapping[str, str]):
        self._log = log
        with log.open("w") as output:
            self.process = subprocess.Popen(
                [str(INSTALLED / name), *arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **environment},
            )

    def wait_for(self, text: str, seconds: float = 90.0) -> None:
        """Wait until the output contains ``text``; print the output and exit if the process ends or takes too long."""
        deadline = time.monotonic() + seconds
        while text not in self._log.read_text():
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise SystemExit(f"{self._log.stem}: {text!r} did not appear in its output:\n{self._log.read_text()}")
            time.sleep(0.1)

    def stop(self) -> int:
        """Interrupt the process; returns its exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(timeout=30)
