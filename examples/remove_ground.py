"""Write the obstacles of each scan of a folder, with their height over the ground: IN OUT.

IN holds scans of any format that `gp-ground-seg segment` reads, and OUT will hold a .npy for each:
x, y, z, height and standard deviation of the ground under it [m].
"""

import sys
from pathlib import Path

import numpy as np

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.data.inputs import list_inputs


def main(source, target):
    """Write a file for each scan, and say what is in it."""
    segmenter = GroundSegmenter()
    Path(target).mkdir(exist_ok=True)
    for item in list_inputs(Path(source)):
        xyz = item.read().xyz
        result = segmenter.segment(xyz)
        rows = np.column_stack([xyz, result.height, result.ground_std])[~result.is_ground]
        np.save(Path(target, f'{Path(item.name).stem}.npy'), rows)
        print(item.name, result)


if __name__ == '__main__':
    main(*sys.argv[1:])
