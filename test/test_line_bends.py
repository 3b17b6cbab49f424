import numpy as np
import pytest

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.experiments.scene_scores import SceneScan
from gp_ground_seg.frame import Candidates
from gp_ground_seg.parameters.config import LinesConfig
from gp_ground_seg.parameters.presets import find_preset
from gp_ground_seg.pipeline.line_bends import set_off_at_bend
from gp_ground_seg.pipeline.line_extraction import extract_lines

ROAD = np.array([3.0, 4.0, 5.0, 6.6, 9.2, 15.0])
SPARSE = LinesConfig(max_gap=6.0, max_gap_growth=0.6)


def bends(r, z, offsets=None, min_extent=8.0, max_slope=1.0):
    n = len(r)
    found = Candidates(
        np.asarray(r, dtype=float),
        np.asarray(z, dtype=float),
        np.arange(n),
        np.ones(n),
        np.array([0, n] if offsets is None else offsets),
        np.zeros(n, dtype=np.int32),
    )
    lines = extract_lines(found, SPARSE)
    return list(lines.start), list(
        set_off_at_bend(lines, found, SPARSE.offset_tolerance, min_extent, max_slope)
    )


def scene(rise, at=(19.5, 26.0, 40.0), step=0.0):
    """A level road, then a slope that begins at 16 m."""
    at = np.array(at)
    return np.append(ROAD, at), np.append(np.zeros(len(ROAD)), step + rise * (at - 16.0))


@pytest.mark.parametrize('rise', [0.12, 0.3, -0.12])
def test_a_slope_sets_off_at_a_bend(rise):
    assert bends(*scene(rise)) == ([0, 6, 9], [False, True])


@pytest.mark.parametrize('step', [0.6, 1.5])
def test_a_step_is_no_bend(step):
    assert bends(*scene(0.05, step=step)) == ([0, 6, 9], [False, False])


def test_what_is_short_steep_or_of_two_candidates_does_not_count():
    r, z = scene(0.12)
    assert bends(r, z, min_extent=21.0)[1] == [False, False]
    assert bends(r, z, max_slope=0.1)[1] == [False, False]
    assert bends(r[:-1], z[:-1], min_extent=1.0) == ([0, 6, 8], [False, False])


def test_the_line_before_lies_in_the_same_segment():
    assert bends(*scene(0.12), offsets=[0, 6, 9])[1] == [False, False]
    assert bends([], [], offsets=[0, 0])[1] == []


def test_a_ramp_seen_by_few_rings_is_ground():
    scan = SceneScan('vlp-16', 'ramp', 0, 0.0).simulate()
    config = find_preset('vlp16').config
    far = scan.is_ground & (np.hypot(*scan.points[:, :2].T) > 25.0)
    missed = {}
    for extent in (config.growth.min_bend_extent, 1000.0):
        segmenter = GroundSegmenter(config.replace(**{'growth.min_bend_extent': extent}))
        missed[extent] = (segmenter.segment(scan.points).label[far] != 1).sum()
    assert missed[config.growth.min_bend_extent] < 0.6 * missed[1000.0]
