"""Location of the package's data files, in the source tree or an installed workspace."""

from __future__ import annotations

from pathlib import Path

PACKAGE = "monoforce_ros"


def share_directory() -> Path:
    """Folder that holds ``config/``, ``msg_defs/`` and ``bags/``.

    The source tree takes precedence if the package is imported from it, so that a stale installation is never used.

    Raises:
        FileNotFoundError: there is neither a source tree nor an installation.
    """
    source_tree = Path(__file__).resolve().parent.parent.parent
    if (source_tree / "package.xml").is_file():
        return source_tree
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory(PACKAGE))
    except PackageNotFoundError as error:
        raise FileNotFoundError(
            f"the data files of {PACKAGE} were not found next to the code or below AMENT_PREFIX_PATH: "
            "source install/setup.bash of the workspace in which the package was built"
        ) from error
