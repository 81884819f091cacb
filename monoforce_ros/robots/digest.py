"""Digest of a robot: a hash of all that its file says, to notice results of another robot."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from torch import Tensor

from monoforce_ros.robots.robot_model import RobotModel


def robot_digest(robot: RobotModel) -> str:
    """Hash of all fields of a robot: shape, mass, drives, sensors and effects."""
    return hashlib.sha256(json.dumps(_content(robot), sort_keys=True).encode()).hexdigest()


def _content(value: Any) -> Any:
    if isinstance(value, Tensor):
        return _content(value.detach().cpu().numpy())
    if isinstance(value, np.ndarray):
        return [str(value.dtype), list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _content(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _content(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_content(entry) for entry in value]
    return repr(value)
