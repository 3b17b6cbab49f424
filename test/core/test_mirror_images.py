"""Mirror images on a wet road are found and are no ground; a dry scan has none."""

import dataclasses

import numpy as np
import pytest
from conftest import simulated

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.pipeline.ground_plane import fit_plane
from gp_ground_seg.core.pipeline.mirror_images import (
    DEEP,
    MIRRORED,
    find_mirror_images,
    in_sight,
    mirror_share,
)
from gp_ground_seg.core.pipeline.points import moved
from gp_ground_seg.lab.simulation import SENSORS

WET = [('hdl-64e', 0), ('vlp-16', 1)]
DRY = ['ramp', 'rough', 'ditch', 'dike', 'hills', 'urban', 'car_park', 'low_boxes']


def images_in(points, sensor):
    """Which points are found to be images, and how high what they are images of is over them."""
    config = dataclasses.replace(Config(), sensor=sensor)
    pose = GroundSegmenter(config).segment(points).pose
    about = moved(points[:, :3], pose.origin)
    scan = NumpyBackend().build_grid(pose.level(np.ascontiguousarray(about)), config)
    found = find_mirror_images(scan, pose)
    is_image = np.zeros(len(points), dtype=bool)
    is_image[found.points] = True
    return is_image, found


@pytest.mark.parametrize(('sensor', 'seed'), WET)
def test_images_are_found_and_raised_and_the_wet_road_is_ground(backend, sensor, seed):
    scan = simulated('wet_road', sensor, seed)
    points, truth = scan.points, scan.is_ground
    height = points[:, 2] - scan.ground_z
    is_image, found = images_in(points, Config().sensor)
    is_deep = ~truth & (height < -DEEP - 0.1)
    assert is_deep.sum() > 300
    assert is_image[is_deep].mean() > 0.98
    assert not is_image[truth | (height > 0.0)].any()
    raised = found.raised(points[:, :3]) - points[:, :3]
    np.testing.assert_array_equal(np.flatnonzero(raised.any(axis=1)), found.points)
    # The plane is up to 0.17 m off where images are told, and so twice that what is raised.
    mirrored = height[found.points] + found.rise
    np.testing.assert_allclose(mirrored, -height[found.points], atol=0.35)
    result = GroundSegmenter(backend=backend).segment(points)
    is_ground = result.label == Label.GROUND
    assert (is_ground & truth).sum() / (is_ground | truth).sum() > 0.93
    below = ~truth & (height < -0.3)
    assert is_ground[below].mean() < 0.01
    # The ground at an image is above it.
    missed = (result.ground_z - scan.ground_z)[below]
    assert np.nanmedian(np.abs(missed)) < 0.01
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


def test_images_are_told_by_where_rays_start():
    points = simulated('wet_road', 'hdl-64e', 0).points
    expected = images_in(points, Config().sensor)[0]
    lifted = points[:, :3] + np.float32([0.0, 0.0, 1.5])
    told = Config().replace(**{'sensor.origin_z': 1.5}).sensor
    assert (images_in(lifted, told)[0] != expected).mean() < 1e-3
    # In the frame of a vehicle that does not say where its sensor is, nothing is known.
    assert not images_in(lifted, Config().sensor)[0].any()


def hall(height, steepest, *, is_polished=False, has_tables=False):
    """Scan by 64 beams in a hall of 16 by 12 m, and which of its returns are of the floor.

    A polished floor mirrors a third of the rays. Tables stand in rows, 0.72 m high, with 0.6 and
    0.7 m between them.
    """
    rng = np.random.default_rng(0)
    elevation, azimuth = np.meshgrid(
        np.linspace(-steepest, steepest, 64), np.linspace(-np.pi, np.pi, 1024, endpoint=False)
    )
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)])
    rays = np.concatenate([rays, np.sin(elevation)[None]]).reshape(3, -1)
    sides = np.abs(rays / np.array([[8.0], [6.0], [1.0]]))
    down, down_to_table = rays[2] < 0.0, np.where(rays[2] < 0.0, (0.72 - height) / rays[2], 99.0)
    to_wall = 1.0 / np.maximum(sides[0], sides[1])
    to_floor = np.where(down, -height / rays[2], np.inf)
    to_ceiling = np.where(down, np.inf, (3.0 - height) / rays[2])
    t = np.minimum(np.minimum(to_wall, to_floor), to_ceiling)
    is_floor = t == to_floor
    if is_polished:
        mirrored = is_floor & (rng.random(len(t)) < 0.35)
        # Below the floor the hall stands upside down.
        t[mirrored] = np.minimum(to_wall, (3.0 + height) / np.abs(rays[2]))[mirrored]
        is_floor &= ~mirrored
    if has_tables:
        x, y = rays[:2] * down_to_table
        hits = (down_to_table < t) & (x % 2.2 < 1.6) & (y % 1.5 < 0.8)
        t[hits], is_floor[hits] = down_to_table[hits], False
    points = rays * (t + rng.normal(0.0, 0.01, len(t)))
    return points.T.astype(np.float32), is_floor


def test_the_floor_of_a_polished_hall_is_the_ground(backend):
    points, is_floor = hall(0.45, 0.78, is_polished=True)
    wrong = [np.nan, np.inf, -np.inf, 1e38]
    points[::100] = np.resize(wrong, len(points[::100]))[:, None]
    is_floor[::100] = False
    result = GroundSegmenter(backend=backend).segment(points)
    assert result.pose.height == pytest.approx(0.45, abs=0.03)
    assert (result.is_ground & is_floor).sum() / (result.is_ground | is_floor).sum() > 0.9


def test_a_polished_floor_is_a_mirror_and_tables_are_not():
    for height, steepest, plane_z, kind in (
        (0.45, 0.78, -0.45, {'is_polished': True}),
        (0.45, 0.78, -0.45, {}),
        (1.2, 0.3, -0.48, {'has_tables': True}),
    ):
        scan = NumpyBackend().build_grid(hall(height, steepest, **kind)[0], Config())
        plane = fit_plane(in_sight(scan.candidates), 1.0)
        assert -plane.height == pytest.approx(plane_z, abs=0.03)
        share = mirror_share(plane, scan)
        assert share > MIRRORED + 0.2 if 'is_polished' in kind else share < MIRRORED - 0.1
