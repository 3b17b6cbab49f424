"""Solids: where rays enter them, against point-by-point sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.simulation import objects
from gp_ground_seg.simulation import terrain as landforms
from gp_ground_seg.simulation.objects import Box, Cylinder, Kind, nearest_solid
from gp_ground_seg.simulation.scenes import SCENES

SENSOR_POSITION = np.array([0.0, 0.0, 1.73])


def inside(solid, points):
    """Obvious twin of `Solid.entry`: whether points lie in the solid."""
    x, y = points[..., 0] - solid.x, points[..., 1] - solid.y
    if isinstance(solid, Box):
        u = x * math.cos(solid.yaw) + y * math.sin(solid.yaw)
        v = y * math.cos(solid.yaw) - x * math.sin(solid.yaw)
        outline = (np.abs(u) <= solid.length / 2) & (np.abs(v) <= solid.width / 2)
    else:
        outline = np.hypot(x, y) <= solid.radius
    return outline & (points[..., 2] >= solid.bottom) & (points[..., 2] <= solid.top)


def rays_towards(rng, solid, n):
    middle = np.array([solid.x, solid.y, (solid.bottom + solid.top) / 2])
    spread = np.array([solid.radius, solid.radius, (solid.top - solid.bottom) / 2])
    direction = middle + 1.3 * spread * rng.uniform(-1.0, 1.0, (n, 3)) - SENSOR_POSITION
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


@st.composite
def draw_solid(draw):
    x = draw(st.sampled_from([-20.0, -7.0, 6.0, 15.0]))
    y, bottom, height = (draw(st.floats(*ends)) for ends in ((-20, 20), (-3, 4), (0.3, 6)))
    length, width, yaw = (draw(st.floats(*ends)) for ends in ((0.3, 8), (0.3, 3), (-4, 4)))
    if draw(st.booleans()):
        return Cylinder(Kind.POLE, x, y, bottom, bottom + height, width)
    return Box(Kind.BOX, x, y, bottom, bottom + height, length, width, yaw)


solids = draw_solid().filter(lambda s: math.hypot(s.x, s.y) > s.radius + 0.1)


@given(solid=solids, seed=st.integers(0, 2**32 - 1))
def test_entry_is_where_the_inside_begins(solid, seed):
    direction = rays_towards(np.random.default_rng(seed), solid, 30)
    entry = solid.entry(np.tile(SENSOR_POSITION, (30, 1)), direction)
    way = np.minimum(entry, 60.0)[:, None]
    before = (
        SENSOR_POSITION + (way * np.linspace(0.0, 1.0 - 1e-9, 500))[..., None] * direction[:, None]
    )
    assert not inside(solid, before).any()
    hit = np.isfinite(entry)
    # A point on the face is inside once the solid is grown by a hair.
    at = SENSOR_POSITION + entry[hit, None] * direction[hit]
    towards_centre = np.array([solid.x, solid.y, (solid.bottom + solid.top) / 2]) - at
    assert inside(solid, at + 1e-9 * towards_centre).all()


@given(solid=solids, seed=st.integers(0, 2**32 - 1))
def test_no_ray_through_the_middle_misses(solid, seed):
    height = np.random.default_rng(seed).uniform(0.01, 0.99, 20) * (solid.top - solid.bottom)
    targets = np.column_stack([np.tile([solid.x, solid.y], (20, 1)), solid.bottom + height])
    direction = targets - SENSOR_POSITION
    distance = np.linalg.norm(direction, axis=1, keepdims=True)
    entry = solid.entry(np.tile(SENSOR_POSITION, (20, 1)), direction / distance)
    assert (entry < distance[:, 0]).all()


def test_axis_parallel_rays_and_starts_inside():
    box = Box(Kind.BOX, 5.0, 0.0, -1.0, 1.0, 2.0, 2.0, 0.0)
    origin = np.array([[0.0, 0.0, 0.0], [0.0, 1.5, 0.0], [5.0, 0.0, 0.0], [5.0, 0.0, 4.0]])
    direction = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(box.entry(origin, direction), [4.0, np.inf, np.inf, 3.0])
    rod = Cylinder(Kind.POLE, 5.0, 0.0, -1.0, 1.0, 0.5)
    np.testing.assert_allclose(rod.entry(origin, direction), [4.5, np.inf, np.inf, 3.0])


@pytest.mark.parametrize('seed', [0, 1])
def test_common_start_gives_what_single_starts_give(seed):
    """The sorted fan leaves out no ray, also behind the sensor and for solids around it."""
    rng = np.random.default_rng(seed)
    scene = SCENES['urban'](seed)
    around = Cylinder(Kind.POLE, 0.5, 0.0, 2.0, 3.0, 2.0)
    direction = np.column_stack([rng.normal(size=(3000, 2)), rng.uniform(-0.5, 0.6, 3000)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    solids = (*scene.solids, around)
    fast = nearest_solid(solids, SENSOR_POSITION, direction)
    plain = nearest_solid(solids, np.tile(SENSOR_POSITION, (3000, 1)), direction)
    np.testing.assert_array_equal(fast[0], plain[0])
    np.testing.assert_array_equal(fast[1], plain[1])
    assert np.isfinite(fast[0]).sum() > 500


def test_standing_and_floating_solids_follow_the_terrain():
    hill = landforms.slope(0.1)
    crate = objects.standing_box(hill, 10.0, 0.0, (1.0, 1.0, 0.5))
    assert crate.top == pytest.approx(1.5)
    assert crate.bottom < 1.0 - 0.05
    deck = objects.floating_box(hill, 20.0, 0.0, (4.0, 8.0, 0.5), 3.0)
    assert (deck.bottom, deck.top) == pytest.approx((5.0, 5.5))
    assert objects.pole(hill, -10.0, 0.0, height=4.0).top == pytest.approx(3.0)
    panels = objects.wall(hill, (0.0, 5.0), (30.0, 5.0), 2.0)
    assert sum(panel.length for panel in panels) == pytest.approx(30.0)
    assert [panel.top for panel in panels] == pytest.approx([2.0 + 0.1 * p.x for p in panels])
    assert {panel.kind for panel in panels} == {Kind.WALL}


@pytest.mark.parametrize('name', SCENES)
@pytest.mark.parametrize('seed', range(3))
def test_lane_of_the_drive_is_free(name, seed):
    """No solid is where a car 2 m wide and 2 m high drives along x."""
    scene = SCENES[name](seed)
    x, y, above = np.meshgrid(
        np.arange(-5.0, 90.0, 0.1), np.linspace(-1.0, 1.0, 9), np.linspace(0.1, 2.0, 5)
    )
    lane = np.stack([x, y, scene.terrain.height(x, y) + above], axis=-1).reshape(-1, 3)
    assert not any(inside(solid, lane).any() for solid in scene.solids)
