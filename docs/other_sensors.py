"""Score labelled scans of other sensors: ``python docs/other_sensors.py FOLDER``.

FOLDER has SENSOR__FRAME.npz: `xyzi` (N, 4) [m], and one or both of

- `ground` (N,): 1 is ground, 0 is not, -1 does not count;
- `box_center`, `box_size` (B, 3) [m], `box_rotation` (B, 3, 3): vehicles. The rows of a rotation
  turn the axes of the cloud into those of the box.

A vehicle with ten returns from 0.3 m over the bottom of its box on is lost if more than half of
them are called ground. Patchwork++ is told the height over the labelled ground within 8 m, or else
ours.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.core.frame import BoolArray, FloatArray
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod

NEAR, MARGIN, FOOT = 8.0, (0.1, 0.05), 0.3
"""For the height; about a box, and above it; below its counted part [m]."""
LEAST = 10
"""Returns on a vehicle that counts."""


def height_over(points: FloatArray, is_ground: BoolArray) -> float:
    """Height of the origin over a plane through the nearest ground [m]."""
    near = is_ground & (np.hypot(*points[:, :2].T) < NEAR)
    sides = np.column_stack([points[near, :2], np.ones(np.count_nonzero(near))])
    return float(-np.linalg.lstsq(sides, points[near, 2], rcond=None)[0][2])


def vehicles(scan: dict[str, FloatArray]) -> Iterator[BoolArray]:
    """Yield which points are returns of each vehicle."""
    boxes = (scan.get(f'box_{name}', ()) for name in ('center', 'size', 'rotation'))
    for center, size, rotation in zip(*boxes, strict=True):
        place, half = (scan['xyzi'][:, :3] - center) @ rotation, np.asarray(size) / 2.0
        z, within = place[:, 2], (np.abs(place[:, :2]) <= half[:2] + MARGIN[0]).all(axis=1)
        own = within & (z >= FOOT - half[2]) & (z <= half[2] + MARGIN[1])
        if np.count_nonzero(own) >= LEAST:
            yield own


def counts(scan: dict[str, FloatArray]) -> Counter[str]:
    """Return sums of one scan, of ours and of Patchwork++."""
    points, truth = scan['xyzi'], scan.get('ground')
    result = GroundSegmenter().segment(points)
    height = result.pose.height if truth is None else height_over(points, truth == 1)
    peer = PatchworkppMethod(height)
    peer.run(points)
    own = list(vehicles(scan))
    sums = Counter({'scans': 1, 'vehicles': len(own)})
    for who, is_ground in {'': result.is_ground, 'peer ': peer.result().label == 1}.items():
        if truth is not None:
            sums[f'{who}both'] = int((is_ground & (truth == 1)).sum())
            sums[f'{who}either'] = int(((is_ground & (truth == 0)) | (truth == 1)).sum())
        sums[f'{who}lost'] = sum(is_ground[one].mean() > 0.5 for one in own)
    return sums


def main(folder: str) -> int:
    """Print the table."""
    of_sensor: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for path in sorted(Path(folder).glob('*.npz')):
        of_sensor[path.stem.partition('__')[0]].update(counts(dict(np.load(path))))
    lines = [
        '| sensor | scans | IoU | peer IoU | vehicles | lost | peer lost |',
        '| --- | --: | --: | --: | --: | --: | --: |',
    ]
    for name, sums in of_sensor.items():
        cells = [str(sums['scans']), *'-----']
        if sums['either']:
            shares = (sums[f'{who}both'] / sums[f'{who}either'] for who in ('', 'peer '))
            cells[1:3] = (f'{100.0 * share:.2f}' for share in shares)
        if sums['vehicles']:
            cells[3:] = (str(sums[key]) for key in ('vehicles', 'lost', 'peer lost'))
        lines.append(f'| {name} | {" | ".join(cells)} |')
    sys.stdout.write('\n'.join([*lines, '']))
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
