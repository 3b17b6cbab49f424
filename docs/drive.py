"""Animate a simulated drive for README: ``python docs/drive.py drive.gif``."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from gp_ground_seg import GroundSegmenter, Label
from gp_ground_seg.cli.demo import simulated_drive
from gp_ground_seg.core.errors import in_thousands
from gp_ground_seg.lab.plotting import CAMERA, plot_scan_view

N_SCANS, PERIOD = 30, 100
"""Number of scans, and the time that each is shown [ms]: as fast as the drive."""
WIDTH, N_COLOURS = 720, 24


def main(path: str) -> int:
    """Segment and draw each scan; write one file of all."""
    pictures, n_points, n_ground = [], 0, 0
    segmenter = GroundSegmenter()
    with tempfile.TemporaryDirectory() as folder:
        still = Path(folder) / 'scan.png'
        for points, _, _ in simulated_drive(N_SCANS):
            label = segmenter.segment(points).label
            n_points, n_ground = n_points + len(label), n_ground + np.sum(label == Label.GROUND)
            plot_scan_view(points, label, still, camera=CAMERA)
            with Image.open(still) as picture:
                small = picture.convert('RGB').reduce(round(picture.width / WIDTH))
            pictures.append(small.quantize(N_COLOURS))
    first, *rest = pictures
    first.save(path, save_all=True, append_images=rest, duration=PERIOD, loop=0)
    said = f'{N_SCANS} scans: {in_thousands(n_points)} points, {in_thousands(n_ground)} ground'
    print(f'Simulated street, {said}, written to {path}')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
