"""Fit a kernel of scikit-learn to our inliers, segment by segment: SCAN [PRESET].

Needs scikit-learn (`pip install scikit-learn`). Both surfaces rest on the same inliers and
are compared at the same ranges; neither is the truth. Ours also uses neighbours, the relief of the
terrain, a sloping mean and weights of the inliers: not with PRESET `paper`. Put your own kernel
into KERNEL.
"""

import sys
import warnings
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.data.inputs import list_inputs

KERNEL = 0.1 * RBF(5.0, (0.5, 50.0)) + WhiteKernel(1e-3, (1e-5, 1e-1))
LEAST = 4
"""Inliers that a segment must have."""


def main(scan, preset='default'):
    """Print root mean squares over all segments [m]."""
    result = GroundSegmenter(preset).segment(list_inputs(Path(scan))[0].read().xyz)
    # Few inliers leave a parameter at its bound.
    warnings.filterwarnings('ignore', category=ConvergenceWarning)
    rows = []
    for m in range(result.grid.n_segments):
        ground = result.segment(m)
        r, z = ground.r[ground.inlier, None], ground.z[ground.inlier]
        if len(r) < LEAST:
            continue
        other = GaussianProcessRegressor(KERNEL, normalize_y=True).fit(r, z)
        mean, std = other.predict(ground.knots[:, None], return_std=True)
        rows.append(np.square([mean - ground.mean, std, ground.std]).mean(axis=1))
    apart, other_std, our_std = np.sqrt(np.mean(rows, axis=0))
    print(
        f'{len(rows)} segments: surfaces {apart:.3f} m apart; deviation {other_std:.3f} m, '
        f'ours {our_std:.3f} m'
    )


if __name__ == '__main__':
    main(*sys.argv[1:])
