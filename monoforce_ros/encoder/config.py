"""EncoderConfig: the shape of a terrain encoder, stored beside its weights."""

from __future__ import annotations

from dataclasses import dataclass

from monoforce_ros.terrain import Grid, TerrainDefaults

BACKBONES = ("mobilenet_v3_small", "mobilenet_v3_large")


@dataclass(frozen=True)
class EncoderConfig:
    """Everything that fixes an encoder's tensors and their meaning."""

    backbone: str = "mobilenet_v3_small"
    image_width: int = 320
    image_height: int = 240
    """Images are resized to this before the backbone."""
    map_size: float = 12.8
    """Edge of the square map [m]."""
    resolution: float = 0.1
    """Edge of a cell [m]."""
    depth_minimum: float = 0.6
    depth_maximum: float = 10.0
    depth_bins: int = 48
    """Depths at which a pixel's features may lie [m]; bins are spaced evenly in the logarithm."""
    image_features: int = 32
    """Channels lifted to the map."""
    map_features: int = 48
    """Channels of the bird's-eye-view network."""
    lowest: float = -3.0
    highest: float = 3.0
    """Lifted points further below or above the robot are left out [m]."""
    stiffness: float = TerrainDefaults.stiffness
    damping: float = TerrainDefaults.damping
    friction: float = TerrainDefaults.friction
    """Material at which the heads start [N/m³, N s/m³, -]."""

    def __post_init__(self):
        if self.backbone not in BACKBONES:
            raise ValueError(f"encoder backbone: got {self.backbone!r}, expected one of {BACKBONES}")
        for name, low, high in (
            ("image_width", 32, 4096),
            ("image_height", 32, 4096),
            ("map_size", 1.0, 200.0),
            ("resolution", 0.01, 2.0),
            ("depth_bins", 2, 256),
            ("depth_minimum", 0.05, 20.0),
            ("depth_maximum", 0.5, 500.0),
            ("image_features", 1, 512),
            ("map_features", 8, 512),
        ):
            value = getattr(self, name)
            if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
                raise ValueError(f"encoder {name}: got {value!r}, expected {low} to {high}")
        if self.depth_minimum >= self.depth_maximum:
            raise ValueError(
                f"encoder depth_minimum: got {self.depth_minimum} m, expected less than {self.depth_maximum} m"
            )

    @property
    def grid(self) -> Grid:
        """Grid of the maps."""
        return Grid.square(self.map_size, self.resolution)
