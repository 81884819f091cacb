"""Case search: the search of a recorded drive with the commissioned file of its platform, as ``diagnose`` begins it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from case_recording import CaseFiles

from monoforce_ros.discrepancy.bag_diagnosis import read_with_ground
from monoforce_ros.discrepancy.comparable_windows import comparable_windows, windows_of
from monoforce_ros.discrepancy.explanation import DiagnosisSettings
from monoforce_ros.discrepancy.gap import noisy_motions, residual_scale
from monoforce_ros.discrepancy.hypothesis import corrected_evidence
from monoforce_ros.discrepancy.nominal import NominalModel, with_known_components
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.robots import load_robot


def search_of(files: CaseFiles, nominal_file: Path, onset: float = 0.0) -> Search | None:
    """The search on the windows after ``onset`` [s]; None where nothing can be compared."""
    settings = DiagnosisSettings()
    robot = load_robot(nominal_file)
    nominal = NominalModel.read(nominal_file, settings.samples)
    if nominal is None:
        return None
    map_file = files.terrain(files.bag)
    read, _, _ = read_with_ground(files.bag, robot, str(map_file) if map_file.exists() else "auto")
    evidence, nominal = with_known_components(corrected_evidence(read, robot), nominal)
    starts = comparable_windows(evidence, robot, settings).starts
    noisy = noisy_motions(evidence.smoothed, settings.seed)
    if not len(starts):
        return None
    starts = starts[starts >= starts[0] + round(onset * 1e9)]
    windows = windows_of(evidence, robot, starts, np.array(settings.samples), noisy)
    scale = residual_scale(windows.uncertainty, windows.data, nominal)
    return Search(robot, windows.data, scale, nominal=nominal)
