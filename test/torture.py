"""The torture campaign: `make torture`, `TORTURE_SCALE=100 make torture` for a night.

Each part is a script that runs a range of numbered cases and prints a line for each that fails; a
case follows from its number. Finished ranges are written to the state file, so that a campaign
that was stopped goes on where it was. The record (docs/reliability.md shows the last one) is
printed at the end. The clouds take hours: what ran stays valid on later commits whose segmentation
is the same to the byte.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

TEST = Path(__file__).parent
SEGMENTATION = ('test/torture_clouds.py', 'test/torture_cases.py', 'gp_ground_seg/core')


class Part(NamedTuple):
    """A script, and how many cases make the short campaign of a few minutes."""

    script: str
    n_cases: int
    chunk: int  # cases of one process
    environment: tuple[str, ...] = ()  # NAME=value
    timeout: float = 900.0  # of one process [s]
    sources: Sequence[str] = ('.',)  # paths that the outcome depends on


PARTS = {
    'clouds': Part('torture_clouds.py', 1000, 100, sources=SEGMENTATION),
    'clouds, debugging allocator': Part(
        'torture_clouds.py', 100, 50, ('PYTHONMALLOC=debug', 'MALLOC_PERTURB_=165'),
        sources=SEGMENTATION,
    ),
    'threads, processes, signals, limits': Part('torture_processes.py', 90, 9),
    'damaged compiled code': Part('torture_cache.py', 40, 20),
    'commands killed, interrupted, disk full': Part('torture_writes.py', 40, 20),
    'data sets that change, two runs at once': Part('torture_resume.py', 120, 40),
    'damaged files': Part('torture_files.py', 600, 200),
    'wrong commands': Part('torture_commands.py', 1000, 250),
    'page of tune': Part('torture_servers.py', 200, 100),
    'hostile messages and calls over DDS': Part('torture_ros.py', 400, 200),
}  # fmt: skip


def git(*words):
    """Output of a git command in this repository, '' where there is none."""
    done = subprocess.run(
        ['git', *words], cwd=TEST.parent, capture_output=True, text=True, check=False
    )
    return done.stdout.strip()


def run_chunk(part, first, stop):
    """Return the lines of the cases that failed; a crash or a hang is one."""
    command = [sys.executable, TEST / part.script, str(first), str(stop)]
    environment = {**os.environ, **dict(pair.split('=') for pair in part.environment)}
    environment['PYTHONPATH'] = os.pathsep.join([str(TEST.parent), str(TEST)])
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors='replace', env=environment,
            timeout=part.timeout, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        last = (error.stdout or b'')[-200:].decode(errors='replace').split('\r')[-1]
        return [f'no end within {part.timeout:.0f} s, at case {last}']
    lines = [line.split('\r')[-1] for line in done.stdout.split('\n')]
    failed = [line for line in lines if ': ' in line]
    if done.returncode not in (0, 1) or (done.returncode == 1 and not failed):
        failed.append(f'status {done.returncode} at case {lines[-1]}: {done.stderr[-300:]}')
    return failed


def main():
    """Run what the state file does not hold yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('--scale', type=float, default=float(os.environ.get('TORTURE_SCALE', '1')))
    parser.add_argument('--state', type=Path, default=Path('build/torture.jsonl'))
    parser.add_argument('--part', choices=PARTS, action='append')
    options = parser.parse_args()
    options.state.parent.mkdir(parents=True, exist_ok=True)
    commit = git('rev-parse', '--short', 'HEAD')
    code = {
        name: hashlib.sha1(git('ls-tree', 'HEAD', *part.sources).encode()).hexdigest()[:10]
        for name, part in PARTS.items()
    }
    done = {}
    if options.state.exists():
        for line in options.state.read_text().splitlines():
            entry = json.loads(line)
            if entry.get('code') == code.get(entry['part']):
                done[entry['part'], entry['first'], entry['stop']] = entry

    def run(name, first, stop):
        started = time.monotonic()
        failed = run_chunk(PARTS[name], first, stop)
        seconds = time.monotonic() - started
        entry = {
            'commit': commit, 'code': code[name], 'part': name, 'first': first, 'stop': stop,
            'failed': failed, 'seconds': round(seconds, 1),
        }  # fmt: skip
        with options.state.open('a') as file:
            file.write(json.dumps(entry) + '\n')
        for line in failed:
            print(f'{name}: {line}', flush=True)
        done[name, first, stop] = entry

    names = options.part or list(PARTS)
    wanted = []
    for name in names:
        part = PARTS[name]
        n_cases = max(1, round(part.n_cases * options.scale))
        starts = range(0, n_cases, part.chunk)
        wanted += [(name, first, min(first + part.chunk, n_cases)) for first in starts]
    with ThreadPoolExecutor(max(1, len(os.sched_getaffinity(0)))) as pool:
        list(pool.map(lambda chunk: run(*chunk), [c for c in wanted if c not in done]))
    n_failed = 0
    print(f'\ncommit {commit}, {time.strftime("%Y-%m-%d")}, scale {options.scale:g}')
    for name in names:
        entries = [done[chunk] for chunk in wanted if chunk[0] == name]
        failures = sum(len(entry['failed']) for entry in entries)
        n_failed += failures
        cases = sum(entry['stop'] - entry['first'] for entry in entries)
        seconds = sum(entry['seconds'] for entry in entries)
        others = sorted({entry['commit'] for entry in entries} - {commit})
        where = f' (same code: {", ".join(others)})' if others else ''
        print(f'{name:40} {cases:8} cases {seconds:8.0f} s {failures:4} failures{where}')
    sys.exit(1 if n_failed else 0)


if __name__ == '__main__':
    main()
