"""What the tests share: where real recordings lie, and running installed executables as processes of their own."""

import itertools
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent
INSTALLED = Path(os.environ.get("MONOFORCE_INSTALL", ROOT / "install")) / "monoforce_ros"

# Many small tensors: a pool of threads only adds waiting, above all when several processes share two cores.
torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that start nodes run by themselves, the others beside each other (see the Makefile)."""
    for item in items:
        if not {"start", "peer"} & set(getattr(item, "fixturenames", ())) or item.get_closest_marker("unhurried"):
            continue
        item.add_marker(pytest.mark.node)
        if not item.get_closest_marker("unhurried_nodes"):
            item.add_marker(pytest.mark.robot)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("MONOFORCE_REAL_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "rough").is_dir():
        pytest.skip(f"real recordings are not at {folder} (set MONOFORCE_REAL_DATA)")
    return folder


@pytest.fixture(scope="session")
def demo_bag() -> Path:
    return ROOT / "bags" / "demo"


@pytest.fixture(scope="session")
def executables() -> Path:
    """Folder of the installed executables, which `ros2 run` starts."""
    folder = INSTALLED / "lib" / "monoforce_ros"
    if not folder.is_dir():
        pytest.fail(f"{folder} is missing: build first (make build)")
    return folder


def hears_interrupts() -> None:
    """Let Ctrl-C reach the process that is started: tests may run in the background of a shell, where it is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Process:
    """An installed executable at work, with its output in a file."""

    def __init__(self, command: list[str], log: Path, environment: dict[str, str]):
        self.log = log
        with log.open("w") as output:
            self._process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, env=environment, preexec_fn=hears_interrupts
            )

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def wait_for(self, text: str, seconds: float = 120.0) -> None:
        deadline = time.monotonic() + seconds
        while text not in self.output:
            if not self.running or time.monotonic() > deadline:
                pytest.fail(f"{text!r} did not appear; the process printed:\n{self.output}")
            time.sleep(0.05)

    def wait(self, seconds: float = 120.0) -> int:
        return self._process.wait(timeout=seconds)

    def stop(self, how: int = signal.SIGINT) -> int:
        if self.running:
            self._process.send_signal(how)
        try:
            return self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            # Where each thread hangs: see PYTHONFAULTHANDLER below.
            self._process.send_signal(signal.SIGABRT)
            try:
                self._process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                self._process.kill()
            pytest.fail(f"the process did not end on signal {how}; it printed:\n{self.output}")


_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw2").removeprefix("gw"))
_domains = itertools.cycle(range(1 + 25 * _WORKER, 26 + 25 * _WORKER))


@pytest.fixture(scope="module")
def ros_environment() -> dict[str, str]:
    """Environment with a ROS domain of its own, so that tests and robots do not hear each other."""
    environment = dict(os.environ)
    environment["ROS_DOMAIN_ID"] = str(next(_domains))
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # A crash says where.
    environment["PYTHONFAULTHANDLER"] = "1"
    return environment


@pytest.fixture(scope="module")
def peer(ros_environment):
    """A ROS node of the test's own, in the same domain as the executables that it starts."""
    from predictor_peer import PredictorPeer

    peer = PredictorPeer(ros_environment)
    yield peer
    peer.close()


@pytest.fixture(scope="module")
def start(executables, ros_environment, tmp_path_factory):
    """Start installed executables; those still running at the end are killed."""
    started: list[Process] = []

    def _start(name: str, *arguments: object) -> Process:
        log = tmp_path_factory.mktemp("logs") / f"{name}.log"
        process = Process([str(executables / name), *map(str, arguments)], log, ros_environment)
        started.append(process)
        return process

    yield _start
    for process in started:
        if process.running:
            process.stop(signal.SIGKILL)


@pytest.fixture(scope="module")
def one_thread():
    """Torch on one thread, as the executables run it, for the tests of a module."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
