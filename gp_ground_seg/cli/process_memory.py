"""Memory of a process, as Linux counts it."""

from __future__ import annotations

from pathlib import Path

from gp_ground_seg.errors import GroundSegError

KILOBYTE = 1024


def resident_memory(pid: int) -> int:
    """Return the memory that a process holds now, shared memory included [bytes]."""
    return _status(pid, 'VmRSS')


def peak_memory(pid: int) -> int:
    """Return the most memory that a process ever held [bytes]."""
    return _status(pid, 'VmHWM')


def _status(pid: int, key: str) -> int:
    path = Path('/proc', str(pid), 'status')
    try:
        lines = path.read_text(encoding='ascii', errors='replace').splitlines()
    except OSError as error:
        raise GroundSegError(
            f'{path}: {error.strerror}; memory is measured on Linux only'
        ) from None
    for line in lines:
        name, _, value = line.partition(':')
        if name == key:
            return KILOBYTE * int(value.split()[0])
    raise GroundSegError(f'{path}: has no {key}')
