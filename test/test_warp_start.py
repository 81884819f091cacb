"""What users see when Warp starts on a machine without a GPU."""

import subprocess
import sys

import pytest

START = """
import os
import warp
from monoforce_ros.core import start_warp
written = warp.init
warp.init = lambda: (written(), os.write(2, b"another message\\n"))
start_warp()
os.write(2, b"later\\n")
"""


def test_a_missing_cuda_driver_is_not_reported_and_other_messages_are():
    bare = subprocess.run(
        [sys.executable, "-c", "import warp; warp.init()"], capture_output=True, text=True, timeout=120, check=True
    )
    if "CUDA driver" not in bare.stderr:
        pytest.skip("this machine has a CUDA driver: Warp has nothing to say")
    started = subprocess.run(
        [sys.executable, "-c", START], capture_output=True, text=True, timeout=120, check=True
    )  # fmt: skip
    assert started.stderr == "another message\nlater\n"


def test_the_physics_starts_without_the_warning():
    started = subprocess.run(
        [sys.executable, "-c", "import monoforce_ros.physics.warp_backend"],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert "CUDA" not in started.stderr + started.stdout
