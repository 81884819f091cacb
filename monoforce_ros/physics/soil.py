"""Soil: soft ground that yields under pressure and shear, for wheels that sink, slip and dig in."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch
import yaml
from torch import Tensor

_LARGEST_FILE = 100_000


class SoilError(ValueError):
    """A soil's name, file or value is invalid; the message gives the reason."""


@dataclass(frozen=True)
class Soil:
    """Parameters of a soil; each is a number, or a tensor ``[]`` or ``[B]`` that may require gradients.

    Pressure and sinkage: Bekker, *Introduction to Terrain–Vehicle Systems*, 1969. Shear: Janosi and Hanamoto, 1961.
    Slip sinkage: Lyasko, *Slip sinkage effect in soil–vehicle mechanics*, J. Terramechanics 47 (2010). The constructor
    raises :class:`SoilError` for a number out of its range.
    """

    cohesive_modulus: float | Tensor
    """k_c [N/m^(n+1)]."""
    frictional_modulus: float | Tensor
    """k_φ [N/m^(n+2)]."""
    exponent: float | Tensor
    """n [-]."""
    cohesion: float | Tensor
    """c [Pa]."""
    friction: float | Tensor
    """Tangent of the angle of internal friction φ [-]."""
    shear_modulus: float | Tensor
    """Shear deformation modulus K: displacement at which 63 % of the shear strength is mobilised [m]."""
    rate: float | Tensor = 0.0
    """Rise of the pressure with the sinking speed [s/m]: ``p (1 + rate ż)``."""
    slip_sinkage: float | Tensor = 1.0
    """Share of Lyasko's slip sinkage: at 1 a spinning wheel sinks up to four times as deep, at 0 no deeper."""
    unloading_speed: float | Tensor = 0.001
    """Speed out of the soil at which it no longer pushes [m/s]. Soil is permanently compacted and does not follow."""

    def __post_init__(self):
        for name, (low, high, unit) in LIMITS.items():
            value = getattr(self, name)
            if isinstance(value, Tensor):
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise SoilError(f"soil {name}: got {value!r}, expected {low:g} to {high:g} {unit}")

    def table(self, like: Tensor, batch: int) -> Tensor:
        """All parameters in the order of the fields, ``[B, 9]``, with the precision and device of ``like``."""
        values = [torch.as_tensor(getattr(self, f.name), dtype=like.dtype, device=like.device) for f in fields(self)]
        for f, value in zip(fields(self), values, strict=True):
            if value.ndim > 1 or (value.ndim and len(value) not in (1, batch)):
                raise SoilError(f"soil {f.name}: got shape {tuple(value.shape)}, expected [] or [{batch}]")
        return torch.stack([value.expand(batch) for value in values], dim=-1)


LIMITS = {
    "cohesive_modulus": (0.0, 1e8, "N/m^(n+1)"),
    "frictional_modulus": (1e2, 1e9, "N/m^(n+2)"),
    "exponent": (0.1, 3.0, ""),
    "cohesion": (0.0, 1e6, "Pa"),
    "friction": (0.0, 3.0, ""),
    "shear_modulus": (1e-4, 1.0, "m"),
    "rate": (0.0, 100.0, "s/m"),
    "slip_sinkage": (0.0, 3.0, ""),
    "unloading_speed": (1e-4, 1.0, "m/s"),
}
"""Smallest and largest value of each parameter, and its unit."""

SOIL_PARAMETERS = len(LIMITS)
"""Number of parameters."""

SOILS = {
    "dry_sand": Soil(990.0, 1.52843e6, 1.1, 1040.0, 0.532, 0.025),
    "sandy_loam": Soil(5270.0, 1.51504e6, 0.7, 1720.0, 0.554, 0.025),
    "clayey_soil": Soil(13190.0, 0.69215e6, 0.5, 4140.0, 0.231, 0.006),
    "snow": Soil(4370.0, 0.19672e6, 1.6, 1030.0, 0.358, 0.04),
}
"""Soils by name: dry sand and sandy loam with 15 % moisture (Land Locomotion Laboratory), clayey soil with 38 %
(Thailand), snow (Harrison); values of k_c, k_φ, n, c and φ from Wong, *Theory of Ground Vehicles*, table 2.3. K is
that of its text on shear: 0.025 m in loose sand, 0.006 m in compacted clay, 0.025 to 0.05 m in fresh snow."""


def read_soil(name_or_file: str | Path) -> Soil | None:
    """A soil by name, or from a YAML file with values of the parameters; None for the empty string.

    A file may name one of :data:`SOILS` as ``soil``, whose values it changes.

    Raises:
        SoilError: an unknown name or key, a missing, unreadable or too large file, or a value out of its range.
    """
    text = str(name_or_file)
    if not text:
        return None
    if text in SOILS:
        return SOILS[text]
    if not text.endswith((".yaml", ".yml")):
        raise SoilError(f"soil: got {text!r}, expected one of {sorted(SOILS)} or a YAML file")
    path = Path(text).expanduser()
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise SoilError(f"{path}: {path.stat().st_size} bytes; a soil file has at most {_LARGEST_FILE}")
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise SoilError(f"soil file {path}: {error}") from error
    known = [f.name for f in fields(Soil)]
    if not isinstance(content, dict) or set(content) - {*known, "soil"}:
        got = sorted(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise SoilError(f"soil file {path}: got {got}, expected a mapping with some of {[*known, 'soil']}")
    base = content.pop("soil", None)
    if base is not None and base not in SOILS:
        raise SoilError(f"soil file {path}: soil: got {base!r}, expected one of {sorted(SOILS)}")
    values = {name: getattr(SOILS[base], name) for name in known} if base else {}
    try:
        return Soil(**(values | content))
    except TypeError as error:
        missing = [name for name in known[:6] if name not in content]
        raise SoilError(f"soil file {path}: got no {', '.join(missing)}; or name a known soil as `soil`") from error
    except SoilError as error:
        raise SoilError(f"soil file {path}: {error}") from error
