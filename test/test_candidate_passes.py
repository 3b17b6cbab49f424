"""Compiled passes over the ground candidates against their twins in numpy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.compiled.line_passes import find_lines_compiled
from gp_ground_seg.frame import Candidates
from gp_ground_seg.gp.numpy_backend import NumpyBackend
from gp_ground_seg.pipeline.line_bends import candidates_that_follow
from gp_ground_seg.pipeline.line_extraction import extract_lines, turns

N_TILES = 50
CONFIG = Config().replace(**{'lines.max_gap': 6.0, 'growth.min_bend_extent': 3.0})


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
    size = number.sum()
    return Candidates(
        r=np.concatenate(r),
        z=np.concatenate(z),
        bin=np.concatenate([np.arange(0), *(np.arange(n) * 2 + 3 for n in number)]),
        density=np.exp(rng.normal(0.0, 0.5, size)),
        offsets=np.concatenate([[0], np.cumsum(number)]),
        tile=rng.integers(0, N_TILES, size).astype(np.int32),
    )


def assert_same(ours, theirs):
    for name, own in vars(ours).items():
        other = getattr(theirs, name)
        assert own.dtype == other.dtype
        np.testing.assert_allclose(own, other, rtol=1e-13, atol=1e-15, err_msg=name)


@given(st.integers(0, 10_000), st.sampled_from([1.0, 2.5, 3.0, 10.0]))
def test_from_candidates_to_pseudo_inputs(seed, per):
    candidates = draw_candidates(seed)
    is_footless = np.random.default_rng(seed).uniform(size=N_TILES) < 0.2
    config = CONFIG.replace(**{'latent.candidates_per_pseudo_input': per})
    found = find_lines_compiled(candidates, is_footless, config)
    expected = NumpyBackend().find_lines(candidates, is_footless, config)
    for ours, theirs in zip(found[:3], expected[:3], strict=True):
        assert_same(ours, theirs)
    np.testing.assert_array_equal(found[3], expected[3])
    assert not is_footless[found[0].tile].any()
    assert len(found[0].r) == (~is_footless[candidates.tile]).sum()


def test_the_candidates_drawn_try_every_way_to_follow():
    """What the test above compares: bends, and lines that do and do not continue."""
    at_bend = continued = alone = 0
    for seed in range(40):
        candidates = draw_candidates(seed)
        lines = extract_lines(candidates, CONFIG.lines)
        follows = candidates_that_follow(lines, candidates, CONFIG)
        at_bend += follows[lines.start[:-1]].sum()
        continued += (follows[1:] & (lines.line[1:] == lines.line[:-1])).sum()
        alone += (~follows).sum()
    assert min(at_bend, continued, alone) > 20


@given(st.integers(0, 10_000))
def test_edges_up_to_the_last_candidate(seed):
    candidates = draw_candidates(seed)
    owned = [candidates.bin[candidates.segment == m] for m in range(len(candidates.offsets) - 1)]
    expected = [own[-1] + 2 if len(own) else 0 for own in owned]
    assert list(candidates.n_edges) == expected
    assert candidates.n_edges.dtype == np.int64


@settings(max_examples=300)
@given(st.floats(allow_nan=False), st.floats(allow_nan=False), st.floats(0.001, 1.0))
def test_turns_of_any_slopes(slope, new_slope, tolerance):
    turn = abs(math.atan(new_slope) - math.atan(slope))
    if abs(turn - tolerance) > 1e-12:
        assert turns(slope, new_slope, tolerance, math.tan(tolerance)) == (turn > tolerance)


@settings(max_examples=300)
@given(st.floats(-1.57, 1.57), st.floats(-1.57, 1.57), st.floats(0.001, 1.0))
def test_turns_of_any_angles(angle, new_angle, tolerance):
    slope, new_slope = math.tan(angle), math.tan(new_angle)
    turn = abs(new_angle - angle)
    if abs(turn - tolerance) > 1e-9:
        assert turns(slope, new_slope, tolerance, math.tan(tolerance)) == (turn > tolerance)


@pytest.mark.parametrize('slope', [0.0, 3.0, -1e200, math.inf, -math.inf])
def test_a_vertical_line_turns_like_any_other(slope):
    turn = abs(math.pi / 2 - math.atan(slope))
    for first, second in ((math.inf, slope), (slope, math.inf)):
        assert turns(first, second, 0.1, math.tan(0.1)) == (turn > 0.1)
