"""Rough ground: sums of plane waves under an envelope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.simulation.sensor import FloatArray
from gp_ground_seg.simulation.terrain import Along, Profile, Terrain


@dataclass(frozen=True, eq=False)
class Waves(Terrain):
    """Sum of plane waves A sin(k . (x, y) + phase), scaled by an envelope.

    Attributes
    ----------
    wave_vectors : (n, 2) array
        k of each wave [rad/m].
    amplitudes : (n,) array
        A of each wave [m].
    phases : (n,) array
        [rad].
    envelope : Profile
        Factor of all waves: never negative, of straight pieces, the two outer ones level.

    Raises
    ------
    ConfigError
        If the envelope is of another form.
    """

    wave_vectors: FloatArray
    amplitudes: FloatArray
    phases: FloatArray
    envelope: Profile

    def __post_init__(self) -> None:
        """Check that the envelope can be bounded."""
        pieces = self.envelope.coefficients
        bounded = not pieces[:, 2].any() and not pieces[[0, -1], 1].any()
        if not bounded or (self._envelope_ends() < 0.0).any():
            raise ConfigError(
                'envelope of waves: must be >= 0, of straight pieces, the two outer ones level'
            )

    def along(
        self, at: FloatArray, direction: FloatArray, piece: FloatArray | None = None
    ) -> Along:
        """Terrain below points that move; see `Terrain.along`."""
        factor, factor_slope, _ = self.envelope.along(at, direction, piece)
        height, slope, slope_bound, bend_bound = (np.zeros(len(at)) for _ in range(4))
        # Nothing to add up on a smooth road, which is most of what a sensor sees.
        rough = np.flatnonzero((factor != 0.0) | (factor_slope != 0.0))
        height[rough], slope[rough], slope_bound[rough], bend_bound[rough] = self._full_waves(
            at[rough], direction[rough]
        )
        largest_factor = self._envelope_ends().max(axis=0)[
            self.envelope.piece_index(at if piece is None else piece)
        ]
        return Along(
            factor * height,
            factor * slope + factor_slope * height,
            largest_factor * bend_bound + 2.0 * np.abs(factor_slope) * slope_bound,
        )

    def _full_waves(
        self, at: FloatArray, direction: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Height, slope, and bounds of the sizes of slope and bend, where the envelope is one."""
        x, y = at.T
        dx, dy = direction.T
        height, slope, slope_bound, bend_bound = (np.zeros(len(at)) for _ in range(4))
        for (kx, ky), amplitude, phase in zip(
            self.wave_vectors, self.amplitudes, self.phases, strict=True
        ):
            angle = kx * x + ky * y + phase
            rate = kx * dx + ky * dy
            height += amplitude * np.sin(angle)
            slope += amplitude * rate * np.cos(angle)
            slope_bound += np.abs(amplitude * rate)
            bend_bound += np.abs(amplitude) * rate**2
        return height, slope, slope_bound, bend_bound

    def _envelope_ends(self) -> FloatArray:
        """Envelope at the near and at the far end of each piece, (2, B + 1)."""
        c0, c1, _ = self.envelope.coefficients.T
        edges, anchor = self.envelope.edges, self.envelope.anchor
        near = c0 + c1 * (np.concatenate([anchor[:1], edges]) - anchor)
        far = c0 + c1 * (np.concatenate([edges, anchor[-1:]]) - anchor)
        return np.stack([near, far])

    def breaks(self) -> FloatArray:
        """Edges of the envelope, (B, 3)."""
        return self.envelope.breaks()

    def ceiling(self) -> Terrain:
        """Envelope times the sum of all amplitudes."""
        envelope, total = self.envelope, float(np.abs(self.amplitudes).sum())
        return Profile(
            envelope.heading, envelope.edges, envelope.anchor, envelope.coefficients * total
        )


def random_waves(
    rng: np.random.Generator,
    rms: float,
    wavelengths: tuple[float, float],
    n_waves: int,
    envelope: Profile,
) -> Waves:
    """Waves of random heading and phase that together have one root-mean-square height.

    Parameters
    ----------
    rng : Generator
        Source of headings, phases and wavelengths.
    rms : float
        Root-mean-square height where the envelope is one [m].
    wavelengths : (float, float)
        Shortest and longest wavelength [m]; evenly spread on a log scale. Amplitudes are
        proportional to them, so that every wave has the same slope.
    n_waves : int
        Number of waves.
    envelope : Profile
        Factor of the waves.

    Raises
    ------
    ConfigError
        If a value is out of range.
    """
    shortest, longest = wavelengths
    if not (rms >= 0.0 and 0.0 < shortest <= longest and n_waves >= 1):
        raise ConfigError(
            f'waves: rms = {rms} m, wavelengths = {wavelengths} m, n_waves = {n_waves}: '
            'must be rms >= 0, 0 < shortest <= longest, n_waves >= 1'
        )
    wavelength = np.exp(rng.uniform(np.log(shortest), np.log(longest), n_waves))
    heading = rng.uniform(0.0, 2.0 * np.pi, n_waves)
    phase = rng.uniform(0.0, 2.0 * np.pi, n_waves)
    k = (2.0 * np.pi / wavelength)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    amplitude = wavelength * rms * np.sqrt(2.0 / np.sum(wavelength**2))
    return Waves(k, amplitude, phase, envelope)
