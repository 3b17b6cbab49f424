"""Two checkouts of this package on the same frames, in turns: time, start and memory.

`python test/paired_bench.py OTHER_CHECKOUT [--frames N] [--passes N] [--cold]`,
on an idle machine. Prints ratios of this checkout over the other one.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from conftest import REPOSITORY, find_kitti

WORKER = """
import resource, sys, time
from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.data.semantic_kitti import read_points
mode, backend, *paths = sys.argv[1:]
changes = {'learning.mode': mode, 'runtime.backend': backend}
segmenter = GroundSegmenter(Config().replace(**changes))
clouds = [read_points(path) for path in paths]
segmenter.segment(clouds[0])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, flush=True)
for line in sys.stdin:
    begin = time.perf_counter()
    segmenter.segment(clouds[int(line)]).height
    print(time.perf_counter() - begin, flush=True)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, flush=True)
"""


class Worker:
    """A process that segments frames by the code of one checkout."""

    def __init__(self, checkout, words, paths, **environment):
        begin = time.perf_counter()
        self.process = subprocess.Popen(
            [sys.executable, '-c', WORKER, *words, *map(str, paths)],
            env={**os.environ, 'PYTHONPATH': str(checkout), **environment}, cwd='/', text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self.process.stdout.readline()
        self.start = time.perf_counter() - begin

    def time_of(self, frame):
        self.process.stdin.write(f'{frame}\n')
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self):
        """End the process; return the most memory that it held [MB]."""
        self.process.stdin.close()
        memory = int(self.process.stdout.readline()) / 1024.0
        self.process.wait()
        return memory


def interval_of_median(ratios):
    """95 % bootstrap interval of the median."""
    rng = np.random.default_rng(0)
    medians = np.median(rng.choice(ratios, (2000, len(ratios))), axis=1)
    return np.percentile(medians, [2.5, 97.5])


def compare_frames(other, words, paths, n_passes):
    workers = [Worker(checkout, words, paths) for checkout in (REPOSITORY, other)]
    seconds = np.empty((2, n_passes, len(paths)))
    for run in range(n_passes):
        for frame in range(len(paths)):
            for which in (0, 1) if (run + frame) % 2 else (1, 0):
                seconds[which, run, frame] = workers[which].time_of(frame)
    memory = [worker.close() for worker in workers]
    here, there = np.median(seconds, axis=1)
    low, high = interval_of_median(here / there)
    print(
        f'{" ".join(words):25} {1e3 * np.median(here):7.2f} ms {1e3 * np.median(there):7.2f} ms  '
        f'ratio {np.median(here / there):.3f} ({low:.3f} to {high:.3f})  '
        f'memory {memory[0]:.0f} MB, {memory[1]:.0f} MB'
    )


def compare_starts(other, path, n_runs, *, cold):
    seconds = []
    for _ in range(n_runs):
        for checkout in (REPOSITORY, other):
            with tempfile.TemporaryDirectory() as cache:
                changes = {'NUMBA_CACHE_DIR': cache} if cold else {}
                worker = Worker(checkout, ('every_frame', 'numba'), [path], **changes)
                worker.close()
            seconds.append(worker.start)
    here, there = np.median(np.reshape(seconds, (-1, 2)), axis=0)
    name = 'cold' if cold else 'warm'
    print(f'first frame, {name}: {here:.2f} s, {there:.2f} s, ratio {here / there:.3f}')


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('other', type=Path)
    parser.add_argument('--frames', type=int, default=60)
    parser.add_argument('--passes', type=int, default=5)
    parser.add_argument('--cold', action='store_true', help='an empty cache too')
    given = parser.parse_args()
    kitti = find_kitti()
    assert kitti is not None, 'no labelled KITTI frames: set GP_GROUND_SEG_KITTI to their folder'
    paths = sorted(kitti.glob('sequences/*/velodyne/*.bin'))
    paths = paths[:: max(1, len(paths) // given.frames)]
    other = given.other.resolve()
    print(f'{len(paths)} frames, {given.passes} passes; this checkout first')
    for mode in ('fixed', 'every_frame'):
        compare_frames(other, (mode, 'numba'), paths, given.passes)
    compare_frames(other, ('fixed', 'numpy'), paths[::4], 1)
    compare_starts(other, paths[0], 5, cold=False)
    if given.cold:
        compare_starts(other, paths[0], 2, cold=True)


if __name__ == '__main__':
    main()
