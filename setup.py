"""Installs the package the way ROS 2 expects: executables in lib/monoforce_ros, data in share/monoforce_ros."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "monoforce_ros"
SHARED_FOLDERS = ("config", "launch", "msg_defs", "bags", "models")


def shared_files() -> list[tuple[str, list[str]]]:
    """Every file of the shared folders, listed by the folder it is installed to."""
    listed: dict[str, list[str]] = {}
    for folder in SHARED_FOLDERS:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file():
                listed.setdefault(f"share/{PACKAGE}/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(listed.items())


setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *shared_files(),
    ],
    # Lower bounds: those of Ubuntu 24.04 and of requirements-lowest.in, which make test-lowest tests. OpenCV is only in
    # package.xml: pip does not see Ubuntu's python3-opencv and would install a second one.
    install_requires=[
        "setuptools",
        "matplotlib>=3.6",
        "mujoco>=3.10.0",
        "numpy>=1.26",
        "pycollada>=0.9.1",
        "pyyaml>=6.0.1",
        "rosbags>=0.11.7",
        "safetensors>=0.4.3",
        "scipy>=1.11",
        "torch>=2.4.0",
        "torchdiffeq>=0.2.3",
        "tqdm>=4.66",
        "trimesh>=4.4",
        "urdf-parser-py>=0.0.4",
        "warp-lang>=1.15.0",
    ],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="monoforce_ros maintainers",
    maintainer_email="maintainers@monoforce-ros.example.org",
    description="Predicts robot-terrain interaction from camera images and lidar through differentiable physics.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "predictor = monoforce_ros.nodes.executables:predictor",
            "path_selector = monoforce_ros.nodes.executables:path_selector",
            "simulator = monoforce_ros.nodes.executables:simulator",
            "bag_player = monoforce_ros.nodes.executables:bag_player",
            "bag_recorder = monoforce_ros.nodes.executables:bag_recorder",
            "synthesize = monoforce_ros.synthetic.cli:main",
            "evaluate = monoforce_ros.evaluation.cli:main",
            "convert = monoforce_ros.datasets.cli:main",
            "import_robot = monoforce_ros.importing.cli:main",
            "diagnose = monoforce_ros.discrepancy.cli:main",
            "fit_terrain = monoforce_ros.training.fit_cli:main",
            "train = monoforce_ros.training.train_cli:main",
        ],
    },
)
