"""What workers are worth: ``python test/scale_bench.py KITTI_ROOT``, on an idle machine.

The frames below KITTI_ROOT, repeated to ``--frames``, are segmented into files of a temporary
folder: by one process as it is by default, by one of one thread, and by ``--workers``; in turns,
``--passes`` times. Workers are started before. Overhead: what a worker takes for a frame beyond
the process of one thread, while it has a core to itself.
"""

import argparse
import itertools
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path

from gp_ground_seg.cli import options
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.files import write_file
from gp_ground_seg.data.semantic_kitti import labelled_frames, read_points
from gp_ground_seg.lab.scale.cluster import BLOCK_SIZE, open_runner
from gp_ground_seg.lab.scale.dataset import Scan, segment_block
from gp_ground_seg.lab.scoring.report import Column, Table, describe_environment, machine_line


def write_labels(path, result):
    """Write four bytes per point, as `segment` does."""
    write_file(path, result.label.astype('<u4').tobytes())


def main():
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('root')
    parser.add_argument('--frames', type=int, default=2000)
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--passes', type=int, default=3)
    given = parser.parse_args()
    frames = itertools.islice(itertools.cycle(labelled_frames(given.root)), given.frames)
    scans = [
        Scan(one.points_path, f'{k:06d}.label', '', partial(read_points, one.points_path))
        for k, one in enumerate(frames)
    ]
    blocks = [scans[k : k + BLOCK_SIZE] for k in range(0, len(scans), BLOCK_SIZE)]
    single = Config().replace(**{'runtime.n_threads': 1})
    ways = {
        'one process': (None, Config()),
        'one process, 1 thread': (None, single),
        'one worker': (1, single),
        f'{given.workers} workers': (given.workers, single),
    }
    seconds = {way: [] for way in ways}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(given.passes):
            for way, (workers, config) in ways.items():
                with open_runner(workers, None, options.progress(way)) as runner:
                    segment = partial(segment_block, write_labels, Path(folder), config)
                    list(runner.map_blocks(segment, [scans[:2]] * max(1, runner.n_workers)))
                    start = time.perf_counter()
                    list(runner.map_blocks(segment, blocks))
                    seconds[way].append(time.perf_counter() - start)
    median = {way: statistics.median(own) / len(scans) for way, own in seconds.items()}
    columns = [Column('way'), Column('ms per frame', '.2f', scale=1e3), Column('times', '.2f')]
    rows = [[way, own, median['one process'] / own] for way, own in median.items()]
    overhead = median['one worker'] / median['one process, 1 thread'] - 1.0
    note = f'overhead of a worker: {overhead:.1%} of a frame; {given.passes} passes, median'
    print(
        Table(
            [[*zip(columns, row, strict=True)] for row in rows], f'{len(scans)} frames', [note]
        ).text()
    )
    print(machine_line(describe_environment('distributed')))


if __name__ == '__main__':
    main()
