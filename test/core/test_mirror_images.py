"""Mirror images on a wet road are found and are no ground; a dry scan has none."""

import dataclasses

import numpy as np
import pytest
from conftest import simulated
from rooms import HALL

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.pipeline import mirror_images as images
from gp_ground_seg.core.pipeline.ground_plane import find_planes
from gp_ground_seg.core.pipeline.points import moved
from gp_ground_seg.lab.simulation import SENSORS, Scene
from gp_ground_seg.lab.simulation.objects import floating_box
from gp_ground_seg.lab.simulation.scenes import WetPatch

TURNED = dataclasses.replace(SENSORS['vlp-16'], roll=0.03, pitch=-0.03)
WET = [('hdl-64e', 0), ('hdl-64e', 1), ('vlp-16', 1), (TURNED, 1)]
DRY = ['ramp', 'rough', 'ditch', 'dike', 'hills', 'urban', 'car_park', 'low_boxes']


def images_in(points, sensor):
    """Which points are found to be images, and how high what they are images of is over them."""
    config = dataclasses.replace(Config(), sensor=sensor)
    pose = GroundSegmenter(config).segment(points).pose
    about = moved(points[:, :3], pose.origin)
    scan = NumpyBackend().build_grid(pose.level(np.ascontiguousarray(about)), config)
    found = images.find_mirror_images(scan, pose, None)
    return np.isin(np.arange(len(points)), found.points), found


@pytest.mark.parametrize(('sensor', 'seed'), WET)
def test_images_are_found_and_raised_and_the_wet_road_is_ground(backend, sensor, seed):
    scan = simulated('wet_road', sensor, seed)
    points, truth = scan.points, scan.is_ground
    height = points[:, 2] - scan.ground_z
    is_image, found = images_in(points, Config().sensor)
    is_deep, below = (~truth & (height < -least) for least in (images.DEEP + 0.1, 0.3))
    assert is_deep.sum() > 300
    assert is_image[is_deep].mean() > 0.98
    assert not is_image[truth | (height > 0.0)].any()
    raised = found.raised(points[:, :3]) - points[:, :3]
    np.testing.assert_array_equal(np.flatnonzero(raised.any(axis=1)), found.points)
    # Most are raised over the ground before them; without any, over the plane, up to 0.17 m off.
    missed = np.abs(2.0 * height[found.points] + found.rise)
    assert missed.max() < 0.35 and np.quantile(missed, 0.9) < 0.05
    result = GroundSegmenter(backend=backend).segment(points)
    assert (result.is_ground & truth).sum() / (result.is_ground | truth).sum() > 0.93
    assert result.is_ground[below].mean() < 0.01
    # The ground at an image is above it.
    off = (result.ground_z - scan.ground_z)[below]
    assert np.nanmedian(np.abs(off)) < 0.01
    # Raised to the underside of a car, an image would be ground that climbs to the roofs behind.
    candidates = result.frame.candidates
    at_images = {tuple(place) for place in points[found.points, :2].astype(np.float64).tolist()}
    assert at_images.isdisjoint(zip(candidates.x.tolist(), candidates.y.tolist(), strict=True))


@pytest.mark.parametrize('sensor', ['hdl-64e', 'vlp-16', 'vlp-16-low'])
@pytest.mark.parametrize('scene', DRY)
def test_a_dry_scan_has_no_images(scene, sensor):
    quick = dataclasses.replace(SENSORS[sensor], n_columns=600)
    points = simulated(scene, quick).points
    # As the sensor sees it, and in the frame of a vehicle, whose origin is 0.35 m over the ground.
    for lift in (0.0, quick.height - 0.35):
        lifted = points[:, :3] + np.float32([0.0, 0.0, lift])
        assert not images_in(lifted, Config().sensor)[0].any()


@pytest.mark.parametrize('sensor', ['hdl-64e', 'vlp-16-low'])
def test_images_are_told_by_where_rays_start(sensor):
    points = simulated('wet_road', sensor, 0).points
    expected = images_in(points, Config().sensor)[0]
    assert expected.sum() > 4000
    lifted = points[:, :3] + np.float32([0.0, 0.0, 1.5])
    told = Config().replace(**{'sensor.origin_z': 1.5}).sensor
    assert (images_in(lifted, told)[0] != expected).mean() < 1e-3
    # In the frame of a vehicle that does not say where its sensor is, nothing is known.
    assert not images_in(lifted, Config().sensor)[0].any()


def hall(height, steepest, *, share=0.0, tables=()):
    """Scan by 64 beams in a hall; its floor mirrors a share of the rays."""
    elevations = tuple(np.linspace(steepest, -steepest, 64).tolist())
    sensor = dataclasses.replace(
        SENSORS['hdl-64e'], elevations=elevations, n_columns=1024, height=height, min_range=0.1
    )
    patches = (WetPatch(0.0, 0.0, 40.0, share),)
    return simulated(Scene('hall', HALL.terrain, (*HALL.solids, *tables), patches), sensor)


def test_the_floor_of_a_polished_hall_is_the_ground(backend):
    made = hall(0.45, 0.78, share=0.35)
    points, is_floor = made.points[:, :3].copy(), made.is_ground.copy()
    wrong = [np.nan, np.inf, -np.inf, 1e38]
    points[::100] = np.resize(wrong, len(points[::100]))[:, None]
    is_floor[::100] = False
    result = GroundSegmenter(backend=backend).segment(points)
    assert result.pose.height == pytest.approx(0.45, abs=0.03)
    assert (result.is_ground & is_floor).sum() / (result.is_ground | is_floor).sum() > 0.9


# In rows, 0.72 m high, with 0.6 and 0.7 m between them.
TABLES = [
    floating_box(HALL.terrain, x, y, (1.6, 0.8, 0.04), 0.68)
    for x in np.arange(-7.0, 11.0, 2.2)
    for y in np.arange(-4.0, 6.0, 1.5)
    if abs(x) > 0.9 or abs(y) > 0.5
]


def test_a_polished_floor_is_a_mirror_and_tables_are_not():
    for height, steepest, plane_z, kind in (
        (0.45, 0.78, -0.45, {'share': 0.35}),
        (0.45, 0.78, -0.45, {}),
        (1.2, 0.3, -0.48, {'tables': TABLES}),
    ):
        points = hall(height, steepest, **kind).points[:, :3]
        scan = NumpyBackend().build_grid(np.ascontiguousarray(points), Config())
        plane = next(find_planes(images.in_sight(scan.candidates), 1.0))
        share = images.mirror_share(plane, scan)
        assert -plane.height == pytest.approx(plane_z, abs=0.03)
        assert share > 0.6 if 'share' in kind else share < images.MIRRORED - 0.1
