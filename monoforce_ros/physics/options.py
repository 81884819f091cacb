"""PhysicsOptions: contact and friction models of a rollout."""

from __future__ import annotations

from dataclasses import dataclass

from monoforce_ros.physics.soil import Soil

LOOKUPS = ("bilinear", "constant")
NORMAL_FORCES = ("normal", "vertical")
TANGENTIAL_FORCES = ("coulomb", "sigmoid", "none")


@dataclass(frozen=True)
class PhysicsOptions:
    """Models and numerical settings of a rollout; ``ValueError`` names an invalid field, its value and valid ones."""

    time_step: float = 0.01
    """Time step [s]."""
    lookup: str = "bilinear"
    """``bilinear`` interpolation of the maps or the ``constant`` value of a cell (paper III-C)."""
    normal_force: str = "normal"
    """Direction: the surface ``normal`` or ``vertical`` (paper III-C)."""
    tangential_force: str = "coulomb"
    """``coulomb`` with the actual load, ``sigmoid`` as in paper III-D, or ``none``."""
    gravity: float = 9.81
    """[m/s²]."""
    slip_regularisation: float = 0.02
    """Slip speed at which Coulomb friction reaches 71 % of its maximum [m/s]."""
    soil: Soil | None = None
    """Soft soil instead of the map's stiffness, damping and friction, except where ground is too steep for soil; needs
    ``coulomb``. None: firm ground."""

    def __post_init__(self):
        for name, value, choices in (
            ("lookup", self.lookup, LOOKUPS),
            ("normal_force", self.normal_force, NORMAL_FORCES),
            ("tangential_force", self.tangential_force, TANGENTIAL_FORCES),
        ):
            if value not in choices:
                raise ValueError(f"physics option {name}: got {value!r}, expected one of {choices}")
        if not 1e-5 <= self.time_step <= 0.1:
            raise ValueError(f"physics option time_step: got {self.time_step}, expected 1e-5 to 0.1 s")
        if not 1e-5 <= self.slip_regularisation <= 1.0:
            raise ValueError(
                f"physics option slip_regularisation: got {self.slip_regularisation}, expected 1e-5 to 1 m/s"
            )
        if self.soil is not None and self.tangential_force != "coulomb":
            raise ValueError(f"physics option soil: got tangential_force {self.tangential_force!r}, expected 'coulomb'")
