"""Run pip install, and say how much of its download is done and how long the rest may take.

``python scripts/install_with_progress.py MB WHAT...``: MB is about what is downloaded in all. At
the end it says what was downloaded, and how large the environment is.
"""

import re
import subprocess
import sys
import time
from pathlib import Path

PERIOD = 5.0
"""Time between two lines [s]."""
MEGABYTES = {'k': 1e-3, 'M': 1.0, 'G': 1e3}


def main(total: float, what: list[str]) -> int:
    """Return the exit code of pip, which prints its errors."""
    # Python compiles what it imports; compiling all of it now takes half of the time.
    options = '--disable-pip-version-check', '--no-compile'
    words = [sys.executable, '-m', 'pip', 'install', *options]
    done, start = 0.0, time.monotonic()
    said = start
    with subprocess.Popen([*words, *what], stdout=subprocess.PIPE, text=True) as pip:
        assert pip.stdout is not None
        for line in pip.stdout:
            if line.startswith('Installing collected packages'):
                print('  unpacking ...', flush=True)
            size = re.search(r'(?:Downloading|Using cached) .* \(([\d.]+) ([kMG]?)B\)', line)
            if size is None:
                continue
            # pip names a file when it begins to download it.
            now, left = time.monotonic(), max(total - done, 0.0)
            if done and now > said + PERIOD:
                seconds = left * (now - start) / done
                print(f'  {done:.0f} of {total:.0f} MB, {seconds:.0f} s left', flush=True)
                said = now
            done += float(size[1]) * MEGABYTES.get(size[2], 1e-6)
    # Hard links of a cache count once, as in du.
    files = {
        (s.st_dev, s.st_ino): s.st_blocks for s in map(Path.lstat, Path(sys.prefix).rglob('*'))
    }
    size = 512e-6 * sum(files.values())
    print(f'  {done:.0f} MB downloaded, {size:.0f} MB in {Path(sys.prefix).name}', flush=True)
    return pip.returncode


if __name__ == '__main__':
    sys.exit(main(float(sys.argv[1]), sys.argv[2:]))
