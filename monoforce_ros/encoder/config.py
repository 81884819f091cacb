"""EncoderConfig: architecture and map of a terrain encoder, stored as JSON with its weights."""

from __future__ import annotations

from dataclasses import dataclass

from monoforce_ros.terrain import Grid, TerrainDefaults

SENSORS = ("camera", "lidar", "camera_lidar")
FORMAT = 2
"""Version of the network's inputs and outputs; checkpoints of other versions cannot be used."""
BACKBONES = ("efficientnet_lite0",)

HEIGHT_CHANNELS, SCATTER_CHANNELS, SWEEP_CHANNELS = 3, 7, 8
"""Features of a lidar sweep: its heights; with scatter and the height of ground and objects; with the interpolation,
which are all (:mod:`sweep`)."""
SPREAD_FACTORS = (
    "geometric_spread_factor", "decrease_spread_factor", "image_spread_factor", "image_decrease_spread_factor",
)  # fmt: skip
"""Settings that a calibration determines, not the network."""
FEATURE_STRIDE = 8
"""Stride of the lifted features in pixels of the resized image."""


@dataclass(frozen=True)
class EncoderConfig:
    """Everything that determines an encoder's tensors and their meaning."""

    sensor: str = "camera"
    """``camera``; ``camera_lidar`` for images and a sweep, either of which may be absent; or ``lidar`` for the network
    that densifies a sweep."""
    format: int = FORMAT
    backbone: str = "efficientnet_lite0"
    image_width: int = 320
    image_height: int = 240
    """Input size of the backbone, to which images are resized; multiples of 16 [px]."""
    map_size: float = 12.8
    """Edge of the square map [m]."""
    resolution: float = 0.1
    """Edge of a cell [m]."""
    depth_minimum: float = 0.6
    depth_maximum: float = 10.0
    depth_bins: int = 48
    """Range [m] and number of depth bins, evenly spaced in the logarithm of depth."""
    relative_bins: int = 0
    """Number of bins of depth relative to level ground, as wide as those of depth, that add to them; 0 for none."""
    sweep_channels: int = SWEEP_CHANNELS
    """Features of a lidar sweep, see :func:`~monoforce_ros.encoder.sweep.sweep_features`: 8, 7 (without interpolation),
    or 3 (heights only) of checkpoints that do not name it."""
    image_features: int = 32
    """Channels lifted into the map."""
    map_features: int = 24
    """Channels of the bird's-eye-view network at its finest level."""
    lowest: float = -3.0
    highest: float = 3.0
    """Lifted points outside these heights, relative to the ground under the robot, are discarded [m]."""
    decreases: bool = True
    """Whether H_d is predicted; if not, H_t = H_g, which is plain lift-splat-shoot."""
    edges: bool = True
    """Whether steps that uncertainty blurred into slopes are restored (camera encoders only)."""
    stiffness: float = TerrainDefaults.stiffness
    damping: float = TerrainDefaults.damping
    friction: float = TerrainDefaults.friction
    """Material predicted by untrained heads [N/m³, N s/m³, -]."""
    geometric_spread_factor: float = 1.0
    decrease_spread_factor: float = 1.0
    """Factors on the predicted spreads of H_g and H_d, calibrated on held-out samples so that 90 % bands hold 90 %."""
    image_spread_factor: float = 1.0
    """Further factor on the spread of H_g where no sweep measured anything nearby: errors within one scene go together,
    and with images alone some scenes are off as a whole (docs/training.md)."""
    image_decrease_spread_factor: float = 1.0
    """The same of H_d, from an adaptation to a place that was judged by images alone."""

    def __post_init__(self):
        if self.sensor not in SENSORS:
            raise ValueError(f"encoder sensor: got {self.sensor!r}, expected one of {SENSORS}")
        if self.format != FORMAT:
            raise ValueError(
                f"encoder format: got {self.format}, expected {FORMAT}: it was trained with another release; train it "
                "again, or use the shipped encoder"
            )
        if self.backbone not in BACKBONES:
            raise ValueError(f"encoder backbone: got {self.backbone!r}, expected one of {BACKBONES}")
        for name, low, high in (
            ("image_width", 32, 4096),
            ("image_height", 32, 4096),
            ("map_size", 1.0, 200.0),
            ("resolution", 0.01, 2.0),
            ("depth_bins", 2, 256),
            ("relative_bins", 0, 256),
            ("depth_minimum", 0.05, 20.0),
            ("depth_maximum", 0.5, 500.0),
            ("image_features", 1, 512),
            ("map_features", 8, 512),
            ("lowest", -100.0, -0.1),
            ("highest", 0.1, 100.0),
            ("stiffness", 1.0, 1e12),
            ("damping", 0.0, 1e12),
            ("friction", 0.0, 10.0),
            ("geometric_spread_factor", 0.01, 100.0),
            ("decrease_spread_factor", 0.01, 100.0),
            ("image_spread_factor", 0.01, 100.0),
            ("image_decrease_spread_factor", 0.01, 100.0),
        ):
            value = getattr(self, name)
            whole = isinstance(low, int)
            if not isinstance(value, int if whole else int | float) or isinstance(value, bool):
                kind = "a whole number" if whole else "a number"
                raise ValueError(f"encoder {name}: got {value!r}, expected {kind} from {low} to {high}")
            if not low <= value <= high:
                raise ValueError(f"encoder {name}: got {value!r}, expected {low} to {high}")
        if self.sweep_channels not in (HEIGHT_CHANNELS, SCATTER_CHANNELS, SWEEP_CHANNELS):
            raise ValueError(
                f"encoder sweep_channels: got {self.sweep_channels!r}, expected {HEIGHT_CHANNELS}, "
                f"{SCATTER_CHANNELS} or {SWEEP_CHANNELS}"
            )
        for name in ("decreases", "edges"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"encoder {name}: got {getattr(self, name)!r}, expected true or false")
        if self.image_width % 16 or self.image_height % 16:
            raise ValueError(
                f"encoder image size: got {self.image_width} × {self.image_height}, expected multiples of 16"
            )
        if self.depth_minimum >= self.depth_maximum:
            raise ValueError(
                f"encoder depth_minimum: got {self.depth_minimum} m, expected less than {self.depth_maximum} m"
            )

    @property
    def takes_images(self) -> bool:
        """Whether images are an input."""
        return self.sensor != "lidar"

    @property
    def takes_sweeps(self) -> bool:
        """Whether lidar sweeps are an input."""
        return self.sensor != "camera"

    @property
    def believes(self) -> bool:
        """Whether an output says how far heights that a sweep measured are believed."""
        return self.takes_sweeps and self.sweep_channels > HEIGHT_CHANNELS

    @property
    def interpolates(self) -> bool:
        """Whether another one says how far heights interpolated between them are believed."""
        return self.takes_sweeps and self.sweep_channels > SCATTER_CHANNELS

    @property
    def feature_rows(self) -> int:
        """Of the lifted feature map."""
        return self.image_height // FEATURE_STRIDE

    @property
    def feature_columns(self) -> int:
        """Of the lifted feature map."""
        return self.image_width // FEATURE_STRIDE

    @property
    def grid(self) -> Grid:
        """Grid of the maps."""
        return Grid.square(self.map_size, self.resolution)
