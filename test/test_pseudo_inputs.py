import numpy as np
import pytest
from conftest import hilly_scan

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.frame import N_CLASSES
from gp_ground_seg.parameters.config import LatentConfig
from gp_ground_seg.pipeline.pseudo_inputs import classify_lines


def test_classes_by_slope_and_extent():
    latent = LatentConfig(
        sloped_gradient=0.1, steep_gradient=0.4, medium_extent=1.5, long_extent=5.0
    )
    slopes = np.array([0.0, -0.05, 0.05, 0.1, -0.3, 0.3, 0.4, -2.0, np.inf, np.nan])
    extents = np.array([1.0, 1.5, 5.0, 1.0, 2.0, 9.0, 0.5, 3.0, 6.0, 0.0])
    assert list(classify_lines(slopes, extents, latent)) == [0, 1, 2, 3, 4, 5, 6, 7, 8, 6]


def test_every_line_has_pseudo_inputs_inside_its_extent():
    result = GroundSegmenter(Config()).segment(hilly_scan(6000))
    candidates, lines, pseudo = result.candidates, result.lines, result.pseudo
    for m in range(len(candidates.offsets) - 1):
        own = range(candidates.offsets[m], candidates.offsets[m + 1])
        r_bar = pseudo.r_bar[pseudo.offsets[m] : pseudo.offsets[m + 1]]
        assert (np.diff(r_bar) > 0).all()
        at = [i for i in own if candidates.r[i] in r_bar]
        assert len(at) == len(r_bar)
        assert {lines.line[i] for i in at} == {lines.line[i] for i in own}


@pytest.mark.parametrize('per', [1.0, 3.0, 10.0])
def test_their_number_follows_the_parameter(per):
    config = Config().replace(**{'latent.candidates_per_pseudo_input': per})
    result = GroundSegmenter(config).segment(hilly_scan(6000))
    sizes = np.diff(result.lines.start)
    assert len(result.pseudo.r_bar) == np.maximum(np.rint(sizes / per), 1).sum()
    if per == 1.0:
        np.testing.assert_array_equal(result.pseudo.r_bar, result.candidates.r)


@pytest.mark.parametrize('backend', ['auto', 'numpy'])
def test_first_guess_is_the_mean_log_extent_of_the_class(backend):
    config = Config().replace(**{'runtime.backend': backend})
    result = GroundSegmenter(config).segment(hilly_scan(6000))
    pseudo = result.pseudo
    extent = result.lines.extent(result.candidates)
    classes = classify_lines(result.lines.slope, extent, config.latent)
    bounded = np.log(np.clip(extent, config.length_scale.min, config.length_scale.max))
    for k in range(N_CLASSES):
        members = bounded[classes == k] if (classes == k).any() else bounded
        assert pseudo.first_guess[k] == pytest.approx(members.mean())


def test_no_candidates_no_pseudo_inputs():
    pseudo = GroundSegmenter(Config()).segment(np.empty((0, 3))).pseudo
    assert len(pseudo.r_bar) == 0
    assert np.isfinite(pseudo.first_guess).all()
