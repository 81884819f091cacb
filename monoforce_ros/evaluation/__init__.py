"""How good predictions are: metrics, baselines, figures and reports over recorded drives."""

from monoforce_ros.evaluation.recording_evaluation import RecordingEvaluation, evaluate_recording

__all__ = [
    "RecordingEvaluation",
    "evaluate_recording",
]
