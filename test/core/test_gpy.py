"""The surface against the numbers of GPy, see `gpy_table`; test_likelihood has theirs."""

import json
from pathlib import Path

import numpy as np

from gp_ground_seg import Config
from gp_ground_seg.core.frame import Candidates, Frame, Lines, PseudoInputs

TABLE = json.loads(Path(__file__).with_name('gpy.json').read_text())
SEGMENTS, THETA = TABLE['segments'], np.log(TABLE['theta'])
# All join.
CONFIG = Config().replace(**{
    'observation.slope_std': TABLE['slope'][0],
    'observation.slope_drift': TABLE['slope'][1],
    'surface.look_aside': False,
    'label.rule': 'tolerance',
    'learning.length_scale': 'classes',
    'growth.seed_range': 100.0,
    'growth.seed_height_tolerance': 5.0,
    'growth.max_std': 10.0,
    'growth.max_standardised_residual': 50.0,
})  # fmt: skip


def column(name):
    return np.concatenate([own[name] for own in SEGMENTS])


def offsets(name):
    return np.cumsum([0, *(len(own[name]) for own in SEGMENTS)])


def test_the_surface_is_that_of_gpy(backend):
    r, knots = column('r'), np.array(TABLE['knots'])
    n, n_bar = len(r), len(column('r_bar'))
    place, nowhere = np.zeros(n, np.int64), np.zeros(n, bool)
    # Arrays as a frame has them: for others all would be compiled again.
    knots.setflags(write=False)
    tile = np.zeros(n, np.int32)
    # The last bin: all knots are wanted.
    candidates = Candidates(
        r, column('z'), place + len(knots), np.ones(n), offsets('r'), tile, r, 0.0 * r
    )
    bar = np.zeros(n_bar, np.int64)
    pseudo = PseudoInputs(
        column('r_bar'), column('log_extent'), offsets('r_bar'), bar, column('kind')
    )
    lines = Lines(place, np.zeros(1), np.array([0, n]))
    onward = np.full(n, -np.inf)
    frame = Frame(candidates, lines, pseudo, onward, nowhere, nowhere, knots, 0.0)
    surface, knot_u, _ = backend.estimate_surface(frame, THETA, CONFIG)
    assert surface.inlier.all()
    found = np.stack([knot_u, surface.mean, surface.std], axis=1)
    # Compiled code has length-scales in single precision.
    tolerance, expected = {'numpy': 1e-9, 'numba': 1e-6}[backend.name], column('expected')
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0.0, atol=tolerance)
