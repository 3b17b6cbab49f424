"""Draw the paper's Figure 1 of a segment with matplotlib alone: SCAN SEGMENT PICTURE [PRESET].

Candidates, inliers, the ground with its deviation and five draws from its posterior, and below it
the length-scale with its pseudo-inputs. PRESET is `paper` unless it is given.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.data.inputs import list_inputs


def main(scan, number, picture, preset='paper'):
    """Segment the scan and draw one of its segments."""
    result = GroundSegmenter(preset).segment(list_inputs(Path(scan))[0].read().xyz)
    ground = result.segment(int(number))
    draws = np.random.default_rng(0).multivariate_normal(ground.mean, ground.cov, 5, tol=1e-6)
    _, (above, below) = plt.subplots(2, sharex=True, height_ratios=(2, 1))
    low, high = ground.mean - 2 * ground.std, ground.mean + 2 * ground.std
    above.fill_between(ground.knots, low, high, alpha=0.2, label='ground, 2 deviations')
    above.plot(ground.knots, draws.T, lw=0.6, color='grey')
    above.plot(ground.knots, ground.mean, label='ground')
    above.plot(ground.r, ground.z, 'o', mfc='none', label='candidates')
    above.plot(ground.r[ground.inlier], ground.z[ground.inlier], 'o', label='inliers')
    above.set_ylabel('height z [m]')
    above.legend()
    below.semilogy(ground.knots, ground.length_scale, label='length-scale')
    below.semilogy(ground.pseudo_r, ground.pseudo_l, 's', label='pseudo-inputs')
    below.set(xlabel='range r [m]', ylabel='length-scale l [m]')
    below.legend()
    plt.savefig(picture)
    print(f'segment {number}: {ground.inlier.sum()} inliers, {len(ground.pseudo_r)} pseudo-inputs')


if __name__ == '__main__':
    main(*sys.argv[1:])
