"""Named sets of parameters, with reasons; the files in ``config/`` are generated from here."""

from __future__ import annotations

from dataclasses import dataclass, field

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import ParameterValue, did_you_mean


@dataclass(frozen=True)
class Preset:
    """A named set of parameters; `name` is that of its file in ``config/`` too."""

    name: str
    purpose: str
    overrides: dict[str, tuple[ParameterValue, str]] = field(default_factory=dict)
    """Values that differ from the defaults, each with the reason, by name."""

    @property
    def config(self) -> Config:
        """The defaults with the overrides."""
        return Config().replace(**{name: value for name, (value, _) in self.overrides.items()})

    @property
    def title(self) -> str:
        """First line of its file."""
        return f'Preset {self.name}: {self.purpose}'

    @property
    def reasons(self) -> dict[str, str]:
        """Reason of each override by the name of its parameter."""
        return {name: reason for name, (_, reason) in self.overrides.items()}


_PRESETS = (
    Preset('default', 'For all sensors; chosen on labelled KITTI frames and simulated scans.'),
    Preset(
        'paper',
        'What arXiv 2112.05847 prints, learned until it converges. Of our departures '
        '(docs/algorithm.md) it has the three without a switch: latent values are centred on '
        'their mean in each segment, heights between bin edges are linear, and points without '
        'a model are obstacles. What the paper leaves open is as in the defaults.',
        {
            'sensor.height': (1.73, "of KITTI's sensor, the paper's data"),
            'sensor.roll': (0.0, 'nothing is levelled'),
            'sensor.pitch': (0.0, 'nothing is levelled'),
            'grid.n_segments': (180, 'M in section IV'),
            'grid.n_bins': (120, 'N in section IV'),
            'grid.r_max': (90.0, 'not printed: 120 bins of 0.73 m'),
            'grid.bin_growth': (1.0, 'bins of equal width'),
            'lines.slope_tolerance': (0.02, 'zeta_m in section IV'),
            'lines.offset_tolerance': (0.15, 'zeta_b in section IV'),
            'lines.max_gap_growth': (0.15, "not printed; chosen for the rings of KITTI's sensor"),
            'length_scale.model': ('latent', 'section III-B'),
            'observation.slope_std': (0.0, 'the equations have a level mean'),
            'surface.look_aside': (False, 'each segment has a surface of its own'),
            'growth.max_std': (0.4, 'not printed; chosen for segments by themselves'),
            'growth.max_standardised_residual': (2.0, 'a gate alike above and below'),
            'growth.max_standardised_depth': (2.0, 'a gate alike above and below'),
            'growth.max_line_slope': (0.0, 'the gate alone decides'),
            'growth.min_bend_extent': (1000.0, 'the gate alone decides'),
            'faces.max_normal_z': (0.0, 'no faces'),
            'faces.max_foot_distance': (0.0, 'no faces'),
            'label.ground_tolerance': (0.2, 'zeta_g, not printed: one for all'),
            'label.rule': ('tolerance', 'one zeta_g for all (Algorithm 2)'),
            'learning.objective': ('paper', 'section III-E as printed'),
            'learning.fixed': ('none', 'all hyper-parameters are learned, section III-E'),
            'learning.length_scale': ('classes', 'all segments share L_bar, section III-E'),
            'learning.max_evaluations': (1000, 'learning ends by itself before'),
            'learning.segment_step': (1, 'theta is learned from every segment, section III-E'),
        },
    ),
)
PRESETS = {preset.name: preset for preset in _PRESETS}
"""Every preset by its name."""


def find_preset(name: str) -> Preset:
    """Return the preset `name`; raises ConfigError with the nearest one and all others."""
    preset = PRESETS.get(name)
    if preset is None:
        hint = did_you_mean(name, PRESETS)
        raise ConfigError(f'unknown preset {name!r}{hint} (there are {", ".join(PRESETS)})')
    return preset
