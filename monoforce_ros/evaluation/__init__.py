"""Evaluation: predictions along recordings compared with the measured motion and with baselines."""

from monoforce_ros.evaluation.recording_evaluation import (
    EvaluationError,
    RecordingEvaluation,
    corrected_recording,
    evaluate_recording,
    predict_at,
)

__all__ = [
    "EvaluationError",
    "RecordingEvaluation",
    "corrected_recording",
    "evaluate_recording",
    "predict_at",
]
