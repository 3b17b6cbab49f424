"""How fast labels follow a slider of `tune`: ``python test/tune_bench.py SCAN``.

From the moved slider to new colours on their way to the browser, which then draws them. For an
idle machine.
"""

import statistics
import sys
import time
from pathlib import Path

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.inputs import list_inputs
from gp_ground_seg.lab.scoring.report import describe_environment, machine_line
from gp_ground_seg.lab.viewers.html_page import open_server
from gp_ground_seg.lab.viewers.tuner import Tuner

NAME = 'label.ground_tolerance'
N_MOVES = 100


def main():
    """Move the slider, and print how long that took."""
    inputs, seconds = list_inputs(Path(sys.argv[1])), []
    with open_server(0) as server:
        tuner = Tuner(server, inputs, Config(), [NAME])
        for k in range(N_MOVES + 1):
            start = time.perf_counter()
            tuner.show(0, 'changes', Config().replace(**{NAME: 0.1 + 0.5 * k / N_MOVES}))
            seconds.append(1e3 * (time.perf_counter() - start))
    later = seconds[1:]  # the first one loads code
    n_points, median = len(inputs[0].read().xyz), statistics.median(later)
    print(f'{n_points} points, {N_MOVES} moves: {median:.0f} ms, at most {max(later):.0f} ms')
    print(machine_line(describe_environment('viser')))


if __name__ == '__main__':
    main()
