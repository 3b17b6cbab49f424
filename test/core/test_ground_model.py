"""The ground model by itself against the segmentation it came from."""

import dataclasses

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import at_points
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.pipeline.points import rotation

NAMES = (
    'x', 'y', 'z', 'std', 'length_scale', 'range', 'roll', 'pitch', 'origin_x', 'origin_y',
    'origin_z',
)  # fmt: skip
# No neighbours, so that segments without a model stay without one; r_min of 0 is the hard case.
CONFIGS = [
    Config().replace(**{'learning.mode': 'fixed', **changes})
    for changes in (
        {},
        {'surface.look_aside': False, 'grid.r_min': 0.0, 'grid.n_segments': 17},
        {'grid.n_bins': 5, 'grid.r_max': 30.0, 'grid.bin_growth': 1.0},
    )
]


def half_scan(seed=0):
    """A scan with nothing in a quarter of the directions, and points that are not finite."""
    points = hilly_scan(3000, seed)
    points[np.abs(np.arctan2(points[:, 1], points[:, 0]) - 1.0) < 0.8] = [120.0, 0.0, 0.0]
    points[::97, 1] = np.nan
    return points


def flat(*knots):
    """Ground one metre below the sensor, in eight segments."""
    shape = (8, len(knots))
    return GroundModel(np.array(knots), np.full(shape, -1.0), np.full(shape, 0.1), np.ones(shape))


def columns_of(model, points=None, knots=None):
    """Columns of the model as a cloud has them, with other points or knots where given."""
    points = model.knot_points() if points is None else points
    shape = points.shape[:2]
    rest = model.std, model.length_scale, model.knots if knots is None else knots
    values = *points.transpose(2, 0, 1), *rest, model.roll, model.pitch, *model.origin
    made = [np.broadcast_to(column, shape).astype(np.float32) for column in values]
    return dict(zip(NAMES, made, strict=True))


def rounded(model):
    """The model as it arrives over the network."""
    return GroundModel.from_columns(columns_of(model))


@pytest.mark.parametrize('index', range(len(CONFIGS)))
def test_height_under_every_point_is_that_of_the_segmentation(index):
    points = half_scan(index)
    found = GroundSegmenter(CONFIGS[index]).segment(points)
    model = GroundModel.of(found)
    assert np.isnan(found.ground_z).any()
    assert np.isfinite(found.ground_z).sum() > 1000
    # The model has the relief of the middle of each segment.
    at_knots = found.relief.at_knots(model.knots, found.grid.n_segments)
    x, y = np.nan_to_num(points[:, :2]).T
    expected = found.ground_z - found.relief.at(x, y)
    expected += at_points(model.knots, at_knots, found.grid)
    # Rounding to single precision costs less than a tenth of a millimetre.
    for one, tolerance in ((model, 1e-12), (rounded(model), 1e-4)):
        height, std = one.at(points[:, 0], points[:, 1])
        np.testing.assert_allclose(height, expected, rtol=0, atol=tolerance)
        np.testing.assert_allclose(std, found.ground_std, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(np.float32(found.corrected.mean), np.float32(model.height))
    np.testing.assert_array_equal(np.isnan(model.length_scale), np.isnan(found.log_length_scale))


@pytest.mark.parametrize('tilt', [(0.3, -0.2), (-0.05, 0.5), (3.0, 0.1)])
def test_in_a_tilted_frame_heights_are_on_the_surface(tilt):
    points = half_scan()
    turn = rotation(*tilt)
    segmenter = GroundSegmenter(CONFIGS[0])
    level = GroundModel.of(segmenter.segment(points, (0.0, 0.0)))
    found = segmenter.segment(points @ turn, tilt)
    model = GroundModel.of(found)
    assert (model.roll, model.pitch) == tilt
    places = (points @ turn)[:, :2]
    height, std = model.at(*places.T)
    known = np.isfinite(height)
    assert known.sum() > 1000
    assert np.isfinite(std[known]).all()
    back = np.column_stack([places, height]) @ turn.T
    expected, _ = model._over_level(back[:, 0], back[:, 1])
    # A place beside the edge of a segment may go back and forth between two surfaces.
    off = np.abs(back[:, 2] - expected)[known]
    assert np.quantile(off, 0.99) < 1e-6
    assert np.nanmax(off) < 0.5
    # It is the surface that the same scan gives when it comes level.
    np.testing.assert_allclose(model.height, level.height, atol=0.02)
    # Over the network nothing is lost.
    again, _ = rounded(model).at(*places.T)
    close = np.abs(again - height)[known]
    assert np.quantile(close[np.isfinite(close)], 0.99) < 1e-4


def test_along_a_level_axis_there_is_no_height():
    model = dataclasses.replace(flat(1.0, 2.0), roll=np.pi / 2)
    assert np.isnan(model.at([1.0, 2.0], 0.0)).all()
    # The knots are where they are all the same.
    np.testing.assert_allclose(rounded(model).height, model.height, atol=1e-6)


@settings(max_examples=50)
@given(
    st.floats(-200.0, 200.0) | st.sampled_from([np.nan, np.inf, 0.0, -0.0, 1e300]),
    st.floats(-200.0, 200.0) | st.sampled_from([np.nan, -np.inf, 0.0, -0.0]),
)
def test_any_place_has_a_height_or_none(x, y):
    height, std = flat(1.0, 2.0, 4.0).at(x, y)
    assert height.shape == std.shape == ()
    with np.errstate(over='ignore'):
        inside = np.hypot(x, y) < 4.0
    assert (height == -1.0) == inside
    assert np.isnan(std) != inside
    heights, _ = flat(1.0, 2.0, 4.0).at(np.full((3, 1), x), np.full(2, y))
    np.testing.assert_array_equal(heights, np.full((3, 2), height))


def test_what_is_no_polar_grid_is_refused():
    model = flat(1.0, 2.0, 4.0)
    points, knots = model.knot_points(), model.knots
    moved = points + 0.01, points[:, ::-1], points[::-1], points * [1.0, 1.0, np.inf]
    for broken in (
        *(columns_of(model, points) for points in moved),
        *(columns_of(model, knots=knots) for knots in (knots[::-1], knots * np.nan, knots * 1.01)),
    ):
        with pytest.raises(PointCloudError, match='transformed or filtered'):
            GroundModel.from_columns(broken)
    for part in (np.s_[:0], np.s_[:, :1]):
        small = {name: column[part] for name, column in columns_of(model).items()}
        with pytest.raises(PointCloudError, match='at least 1 segment and 2 knots'):
            GroundModel.from_columns(small)
