"""Use from several threads and processes, under limits and signals.

Each scenario is a program of its own, run again and again with another seed: it must end in time
with the status expected, and print nothing on stderr but what is expected:
`python test/torture_processes.py FIRST STOP`.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from torture_cases import run_cases

PRELUDE = """
import asyncio, os, random, resource, signal, sys, threading, time, warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
import multiprocessing
import numpy as np
from gp_ground_seg import GroundSegmenter
from gp_ground_seg.core.segmenter import warm_up
# A campaign in the background of a shell begins with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
random.seed(seed)
rng = np.random.default_rng(seed)
azimuth, r = rng.uniform(-3.14, 3.14, 20000), rng.uniform(2.0, 60.0, 20000)
scan = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.normal(-1.73, 0.02, 20000)])
scan[::7, 2] += rng.uniform(0.0, 2.0, len(scan[::7]))
"""


class Scenario(NamedTuple):
    """A program, its exit statuses and what it may print on stderr (a regular expression)."""

    code: str
    statuses: tuple[int, ...] = (0,)
    stderr: str = ''


SCENARIOS = {
    'shared by threads': Scenario("""
segmenter = GroundSegmenter()
expected = segmenter.segment(scan).label
with ThreadPoolExecutor(4) as pool:
    for result in pool.map(segmenter.segment, [scan] * 20):
        assert (result.label == expected).all()
"""),
    'forked meanwhile': Scenario("""
warnings.simplefilter('ignore')
segmenter = GroundSegmenter()
expected, busy = segmenter.segment(scan).label, True
def work():
    while busy: segmenter.segment(scan)
thread = threading.Thread(target=work); thread.start()
for _ in range(5):
    time.sleep(random.uniform(0.0, 0.02))
    child = os.fork()
    if child == 0:
        busy = False
        assert (segmenter.segment(scan).label == expected).all()
        sys.exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
busy = False
thread.join()
"""),
    'forked before the first scan': Scenario("""
segmenter = GroundSegmenter()
child = os.fork()
if child == 0:
    segmenter.segment(scan); sys.exit(7)
segmenter.segment(scan)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
"""),
    'exit while busy': Scenario("""
segmenter = GroundSegmenter()
def work():
    while True: segmenter.segment(scan)
for _ in range(2): threading.Thread(target=work, daemon=True).start()
time.sleep(random.uniform(0.2, 0.6))
"""),
    'terminated': Scenario(
        """
threading.Timer(random.uniform(0.05, 0.5), os.kill, (os.getpid(), signal.SIGTERM)).start()
segmenter = GroundSegmenter()
while True: segmenter.segment(scan)
""",
        (-15,),
    ),
    'interrupted': Scenario("""
segmenter = GroundSegmenter()
expected = segmenter.segment(scan).label
for _ in range(30):
    timer = threading.Timer(random.uniform(0.0, 0.05), os.kill, (os.getpid(), signal.SIGINT))
    try:
        timer.start()
        while True: segmenter.segment(scan)
    except KeyboardInterrupt:
        timer.join()
    assert (segmenter.segment(scan).label == expected).all()
"""),
    'little memory': Scenario(
        """
segmenter = GroundSegmenter()
segmenter.segment(scan)
with open('/proc/self/statm') as file: used = int(file.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + random.randrange(2**20, 2**27),) * 2)
big = np.tile(scan, (40, 1))
try: segmenter.segment(big)
except MemoryError: pass
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
segmenter.segment(scan)
""",
        (0, 1),
        r'.*MemoryError.*|.*RLIMIT.*|.*not allowed.*|',
    ),
    'asyncio': Scenario("""
segmenter = GroundSegmenter()
async def run():
    return await asyncio.gather(*(asyncio.to_thread(segmenter.segment, scan) for _ in range(8)))
expected = segmenter.segment(scan).label
for result in asyncio.run(run()): assert (result.label == expected).all()
"""),
    'process pools': Scenario("""
def ground(points): return int((GroundSegmenter().segment(points).label == 1).sum())
if __name__ == '__main__':
    expected = ground(scan)
    for method in ('fork', 'forkserver', 'spawn'):
        context = multiprocessing.get_context(method)
        with ProcessPoolExecutor(2, mp_context=context) as pool:
            assert list(pool.map(ground, [scan] * 4)) == [expected] * 4, method
"""),
}


def run_case(number, folder):
    """Return what is wrong with a run of one scenario, or None; the number is its seed as well."""
    name = list(SCENARIOS)[number % len(SCENARIOS)]
    scenario, program = SCENARIOS[name], folder / f'scenario_{number}.py'
    program.write_text(f'seed = {number}\n{PRELUDE}\n{scenario.code}')
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join([p for p in sys.path if p])}
    try:
        done = subprocess.run(
            [sys.executable, program],
            capture_output=True,
            timeout=180.0,
            env=environment,
            text=True,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f'{name}: did not end within 180 s'
    finally:
        program.unlink()
    if done.returncode not in scenario.statuses:
        return f'{name}: status {done.returncode}: {done.stderr.strip()[-300:]}'
    if not re.fullmatch(scenario.stderr, done.stderr, re.DOTALL):
        return f'{name}: stderr: {done.stderr.strip()[-300:]}'
    return None


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as folder_name:
        run_cases(lambda number: run_case(number, Path(folder_name)))
