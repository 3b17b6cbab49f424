"""Print from where low sensors mark the edges of drops: ``python docs/drops.py``.

A robot drives straight to the edge of each drop. It is marked from where all directions ahead of
``~/scan`` end at it, with ``output.max_step_down: 0.2``; - is never, and - of a ramp is right.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.frame import NOT_FINITE
from gp_ground_seg.data.costmap import DIRECTIONS, SegmentedCloud, scan_ranges
from gp_ground_seg.lab.simulation.scan import (
    MID_360,
    OS1_128,
    VLP_16,
    SensorModel,
    simulate_scan,
)
from gp_ground_seg.lab.simulation.scenes import Scene
from gp_ground_seg.lab.simulation.terrain import Terrain, ditch, polyline

SENSORS = {
    'OS1-64': replace(OS1_128, elevations=OS1_128.elevations[::2], height=0.9, min_range=0.3),
    'VLP-16': replace(VLP_16, height=0.5, min_range=0.3),
    'Mid-360': MID_360,
}
DROPS = {
    'dock of 1.2 m': polyline(0.0, [(0.0, 0.0), (0.0, -1.2)]),
    'step of 0.25 m': polyline(0.0, [(0.0, 0.0), (0.0, -0.25)]),
    'ditch of 1.5 m': ditch(0.0, 0.0, 1.5, 0.9, 0.8),
    'ditch of 0.6 m': ditch(0.0, 0.0, 0.6, 0.4, 0.6),
    'ramp of 10 %': polyline(0.0, [(0.0, 0.0), (10.0, -1.0)]),
    'ramp of 18 %': polyline(0.0, [(0.0, 0.0), (8.0, -1.44)]),
}
DISTANCES = np.arange(6.0, 0.4, -0.25)
MARGIN, AHEAD, SEED = 0.3, 0.2, 3


def is_marked(terrain: Terrain, sensor: SensorModel, distance: float) -> bool:
    """Whether ``~/scan`` ends at the edge in all directions ahead."""
    given = {'output.max_step_down': 0.2, 'output.min_height': 0.15}
    config = Config().replace(**given, **{'sensor.height': sensor.height})
    scan = simulate_scan(Scene('', terrain), sensor, np.random.default_rng(SEED), x=-distance)
    result = GroundSegmenter(config).segment(scan.points)
    cloud = SegmentedCloud(None, result, config, scan.points[:, :3])
    ranges = scan_ranges(cloud.blocked, cloud.places(result.grid.cell != NOT_FINITE))
    towards = (np.arange(DIRECTIONS) + 0.5) * 2.0 * math.pi / DIRECTIONS - math.pi
    return bool((ranges[abs(towards) < AHEAD] < 1.1 * distance + 0.2).all())


def main() -> int:
    """Print the table."""
    lines = [
        f'| Sensor, height | first ring | `raytrace_min_range` | {" | ".join(DROPS)} |',
        f'| --- |{" --: |" * (2 + len(DROPS))}',
    ]
    for name, sensor in SENSORS.items():
        ring = sensor.height / math.tan(-min(sensor.elevations))
        marked = (
            next((f'{d:g} m' for d in DISTANCES if is_marked(terrain, sensor, float(d))), '-')
            for terrain in DROPS.values()
        )
        near = f'{ring:.1f} m | {ring + MARGIN:.1f} m'
        lines.append(f'| {name} at {sensor.height} m | {near} | {" | ".join(marked)} |')
    sys.stdout.write('\n'.join([*lines, '']))
    return 0


if __name__ == '__main__':
    sys.exit(main())
