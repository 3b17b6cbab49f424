"""Lines, slope breaks and pseudo-inputs: both backends, those of the paper against loops."""

import math

import numpy as np
import pytest
from conftest import BACKENDS, fewer
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import extract_lines, pseudo_inputs

from gp_ground_seg import Config
from gp_ground_seg.core.frame import Candidates, Faces
from gp_ground_seg.core.gp.ground import carries_on
from gp_ground_seg.core.pipeline.lines import deming_slope, differs_in_direction, is_walkable

N_TILES = 50
NO_FACES = Faces(*np.zeros((3, N_TILES), dtype=bool))


def candidates_of(r, z, density=None, offsets=None):
    n, density = len(r), np.ones(len(r)) if density is None else density
    r, z, density = (np.asarray(values, dtype=float) for values in (r, z, density))
    offsets = np.array([0, n] if offsets is None else offsets)
    tile = np.zeros(n, dtype=np.int32)
    return Candidates(r, z, np.arange(n), density, offsets, tile, r, np.zeros(n))


def test_a_wall_has_an_infinite_slope_and_one_place_has_none():
    assert deming_slope(0.0, 4.0, 0.0, 1.0) == math.inf
    assert deming_slope(0.0, 0.0, 0.0, 1.0) == deming_slope(4.0, 0.0, 0.0, 1.0) == 0.0


SLOPES = st.floats(allow_nan=False) | st.floats(-1.57, 1.57).map(math.tan)


@settings(max_examples=500)
@given(SLOPES, SLOPES, st.floats(0.001, 1.0))
def test_difference_in_direction(slope, new_slope, tolerance):
    difference = abs(math.atan(new_slope) - math.atan(slope))
    if abs(difference - tolerance) > 1e-9:
        found = differs_in_direction(slope, new_slope, math.tan(tolerance))
        assert found == (difference > tolerance)


def draw_candidates(seed, n_segments=8, most=30):
    """Segments of none to `most` candidates on level, sloped and broken ground."""
    rng = np.random.default_rng(seed)
    number = rng.integers(0, most, n_segments) * rng.integers(0, 2, n_segments)
    r, z = [np.empty(0)], [np.empty(0)]
    for n in number:
        step = rng.uniform(0.3, 1.5, n)
        slope = np.repeat(rng.normal(0.0, 0.3, n), rng.integers(3, 9, n))[:n]
        jump = rng.normal(0.0, 1.0, n) * (rng.uniform(size=n) < 0.1)
        r.append(3.0 + np.cumsum(step))
        z.append(np.cumsum(slope * step + jump) + rng.normal(0.0, 0.01, n))
    r, z, density = np.concatenate(r), np.concatenate(z), rng.normal(0.0, 0.5, number.sum())
    offsets = np.concatenate([[0], np.cumsum(number)])
    tile = rng.integers(0, N_TILES, len(r)).astype(np.int32)
    return candidates_of(r, z, np.exp(density), offsets)._replace(tile=tile)


BOUNDS = 'growth.max_slope', 'growth.min_rise_extent', 'lines.max_density_ratio'


@settings(max_examples=fewer(40, 20))
@given(
    st.integers(0, 10_000),
    st.sampled_from([1.0, 2.5, 3.0, 10.0]),
    st.floats(0.2, 5.0),
    st.sampled_from(['factor', 'classes']),
    st.sampled_from([(1.0, 3.0, 8.0), (0.2, 9.0, 1.5), (10.0, 1.0, 100.0)]),
)
def test_lines_and_pseudo_inputs_are_the_reference(
    compiled_code, seed, per, error_ratio, shared, bounds
):
    candidates = draw_candidates(seed)
    faces = Faces(*(np.random.default_rng(seed).uniform(size=(3, N_TILES)) < 0.2))
    config = Config().replace(
        **{
            'lines.max_gap': 6.0,
            'lines.error_ratio': error_ratio,
            **dict(zip(BOUNDS, bounds, strict=True)),
            'latent.candidates_per_pseudo_input': per,
            'learning.length_scale': shared,
            'length_scale.max': 8.0,
        }
    )
    kept = candidates.where(~faces.has_occluded_base[candidates.tile])
    lines = extract_lines(kept, config.lines)
    found = [backend.extract_lines(candidates, faces, config) for backend in BACKENDS]
    for of_backend in found:
        by_loops = kept, lines, pseudo_inputs(kept, lines, config)
        for ours, theirs in zip(of_backend[:3], by_loops, strict=True):
            for name, value in ours._asdict().items():
                other = getattr(theirs, name)
                assert value.dtype == other.dtype
                np.testing.assert_allclose(value, other, rtol=1e-9, atol=1e-9, err_msg=name)
        np.testing.assert_array_equal(of_backend[3:5], found[0][3:5])


# Heights of four candidates behind three of a level road, 4 m apart.
RISE = np.array([0.2, 0.6, 1.0, 1.4])
AHEAD = {
    'a ramp': (RISE, True),
    'a ramp that falls': (-RISE, True),
    'a steep bank': (3.0 * RISE, False),
    'a bonnet': (RISE + 0.8, False),
    'a terrace': (np.full(4, 0.2), False),
}


@pytest.mark.parametrize(('ahead', 'is_followed'), AHEAD.values(), ids=AHEAD)
def test_the_ground_carries_on_to_a_slope_and_not_to_a_step(backend, ahead, is_followed):
    candidates = candidates_of(5.0 + 4.0 * np.arange(7), np.r_[0, 0, 0, ahead], None, [0, 7, 7])
    _, lines, _, onward, land = backend.extract_lines(candidates, NO_FACES, Config())
    assert list(lines.start) == [0, 3, 7] and not land.any()
    rises_on = carries_on(ahead[0], 4.0, onward[3], land[3])
    assert (is_walkable(ahead[0], 4.0, 0.2) and (ahead[0] <= 0.0 or rises_on)) == is_followed
    # Where it falls, nothing shows that what is there is ground.
    assert not (rises_on and ahead[0] <= 0.0)
    # What nothing is seen behind is shown by the land beside alone.
    assert [carries_on(0.4, 4.0, onward[6], land) for land in (False, True)] == [0, 1]


@pytest.mark.parametrize(
    ('number', 'place', 'n_land'),
    [(11, (40.0, 0.0), 0), (12, (40.0, 0.0), 12), (22, (41.3, 0.5), 22), (22, (41.5, 0.0), 18),
     (22, (40.0, 0.4), 18)],
)  # fmt: skip
def test_what_goes_on_aside_for_14_m_is_land(backend, number, place, n_land):
    # Segments of 1.4 m past the end of the ring; the fourth has a place of its own.
    table = np.zeros((180, 2))
    table[np.arange(175, 175 + number) % 180, 0], table[178] = 40.0, place
    (r, z), is_there = table[table[:, 0] > 0.0].T, table[:, 0] > 0.0
    candidates = candidates_of(r, z, None, np.append(0, np.cumsum(is_there)))
    assert backend.extract_lines(candidates, NO_FACES, Config())[4].sum() == n_land


def test_a_candidate_far_below_changes_no_line_of_other_segments(backend):
    """Differences of running sums would lose all digits behind it."""
    own = draw_candidates(0)
    more = candidates_of(
        np.append(5.0, own.r),
        np.append(-3e30, own.z),
        np.append(1.0, own.density),
        np.append(0, 1 + own.offsets),
    )
    lines, with_it = (
        backend.extract_lines(candidates, NO_FACES, Config()) for candidates in (own, more)
    )
    assert len(own.r) > 50
    np.testing.assert_array_equal(with_it[1].start[2:] - 1, lines[1].start[1:])
    np.testing.assert_allclose(with_it[1].slope[1:], lines[1].slope, rtol=1e-9)
