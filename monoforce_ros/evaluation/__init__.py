"""How good predictions are: metrics, baselines, figures and reports over recorded drives."""

from monoforce_ros.evaluation.drive import DriveEvaluation, evaluate_drive

__all__ = ["DriveEvaluation", "evaluate_drive"]
