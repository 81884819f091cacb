"""Compares a robot's model with recordings and identifies the physical effects that it lacks."""

from monoforce_ros.discrepancy.bag_diagnosis import BagDiagnosis, diagnose_bag, read_evidence
from monoforce_ros.discrepancy.commissioning import commission
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.diagnosis import Diagnosis, DiagnosisSettings, diagnose
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.export import Exported, ExportKind, export_effects
from monoforce_ros.discrepancy.ground import Ground, choose_ground
from monoforce_ros.discrepancy.motion_check import command_delay, motion_faults
from monoforce_ros.discrepancy.verdict import Verdict

__all__ = [
    "BagDiagnosis",
    "Diagnosis",
    "DiagnosisSettings",
    "EffectEstimate",
    "Evidence",
    "ExportKind",
    "Exported",
    "Ground",
    "ParameterEstimate",
    "Verdict",
    "choose_ground",
    "command_delay",
    "commission",
    "complaint",
    "diagnose",
    "diagnose_bag",
    "export_effects",
    "motion_faults",
    "read_evidence",
]
