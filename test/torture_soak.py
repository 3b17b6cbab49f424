"""A soak: the node at 10 Hz for hours, its parameters changed all the time.

`python test/torture_soak.py MINUTES` prints memory, open files and threads of the node each
minute, and ends with 1 if memory at the end is more than 3 % above that after the first minute,
if files or threads grow, or if the node answers less than 90 % of the clouds: the numpy backend,
one setting in nine, is slower than they come.
"""

import itertools
import statistics
import sys
import tempfile
import time
from pathlib import Path

from ros_helpers import linked_process, street, to_message

RATE = 10.0
MAX_GROWTH = 0.03
MIN_ANSWERED = 0.9
SETTINGS = [
    {'label.ground_tolerance': 0.2},
    {'learning.mode': 'fixed', 'sensor.height': 1.7},
    {'grid.r_max': 80.0, 'grid.n_segments': 240},
    {'faces.cell_size': 0.4},
    {'learning.mode': 'every_frame', 'learning.segment_step': 20},
    {'sensor.roll': 0.05, 'sensor.pitch': -0.05},
    {'runtime.backend': 'numpy'},
    {'runtime.backend': 'auto', 'learning.mode': 'every_frame', 'sensor.roll': 0.0},
    {'label.ground_tolerance': 0.15, 'sensor.pitch': 0.0, 'grid.r_max': 50.0},
]


def usage_of(pid):
    """Memory held [bytes], open files and threads of a process."""
    folder = Path(f'/proc/{pid}')
    memory = int((folder / 'statm').read_text().split()[1]) * 4096
    return memory, len(list((folder / 'fd').iterdir())), len(list((folder / 'task').iterdir()))


def main():
    """Soak one node for the minutes of the command line."""
    n_minutes = int(sys.argv[1])
    clouds = [to_message(street(20_000, seed=seed)) for seed in range(20)]
    usage, n_sent, n_answered, n_changed = [], 0, 0, 0
    settings = itertools.cycle(SETTINGS)
    with tempfile.TemporaryDirectory() as folder, linked_process(Path(folder)) as (node, link):
        node.wait_until_settled()
        start = due = time.monotonic()
        while len(usage) <= n_minutes:
            if time.monotonic() >= start + 60.0 * (len(usage) + 1):
                usage.append(usage_of(node.popen.pid))
                memory, n_files, n_threads = usage[-1]
                print(
                    f'{len(usage):4} min: {memory / 1e6:6.1f} MB {n_files:4} files '
                    f'{n_threads:4} threads; {n_sent} sent, {n_answered} answered, '
                    f'{n_changed} parameters set',
                    flush=True,
                )
            link.publisher.publish(clouds[n_sent % len(clouds)])
            n_sent += 1
            # Every third second, so that the first minute has seen all of them.
            if n_sent % int(3 * RATE) == 0:
                given = next(settings)
                results = link.load(given)
                assert all(result.successful for result in results), results
                n_changed += len(given)
            due = max(due + 1.0 / RATE, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            n_answered += len(link.ground.messages)
            for collector in (link.ground, link.obstacles, link.diagnostics):
                collector.messages.clear()
        wrong = []
        first, last = usage[0][0], [statistics.median(c[-5:]) for c in zip(*usage, strict=True)]
        if last[0] > (1.0 + MAX_GROWTH) * first:
            wrong.append(f'memory grew from {first / 1e6:.1f} to {last[0] / 1e6:.1f} MB')
        # How many threads there are depends on the settings of the moment.
        most = [max(column[:10]) for column in zip(*usage, strict=True)]
        if last[1] > most[1] or last[2] > most[2]:
            wrong.append(f'files, threads grew from {most[1:]} to {last[1:]}')
        if n_answered < MIN_ANSWERED * n_sent:
            wrong.append(f'only {n_answered} of {n_sent} clouds were answered')
        if 'Traceback' in node.log:
            wrong.append(node.log[node.log.index('Traceback') :][:500].replace('\n', ' | '))
    for line in wrong:
        print(f'soak: {line}')
    sys.exit(1 if wrong else 0)


if __name__ == '__main__':
    main()
