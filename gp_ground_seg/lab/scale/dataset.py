"""Label files of whole data sets, block by block, and a record of the blocks that are finished."""

from __future__ import annotations

import fcntl
import hashlib
import itertools
import json
import logging
import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, NamedTuple

import gp_ground_seg
from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.atomic_output import PARTIAL_MARK
from gp_ground_seg.data.files import read_bytes, stamp
from gp_ground_seg.lab.scale.cluster import Progress, Runner, cut

_LOGGER = logging.getLogger('gp_ground_seg')
MANIFEST = 'manifest.jsonl'
_MAX_MANIFEST_BYTES = 1 << 32


class Scan(NamedTuple):
    """A scan to label."""

    path: Path
    name: str  # of the file to write, below the output folder
    read: Callable[[], Any]  # returns the points

    def __str__(self) -> str:
        return str(self.path)


class Outcome(NamedTuple):
    """Numbers of the segmented scans: points, times, and what they show of the sensor's pose."""

    n_points: int
    n_ground: int
    seconds: list[float]  # of each scan, segmentation only
    heights: list[float]  # of the sensor, by the scans that show it [m]
    tilts: list[tuple[float, float]]  # roll and pitch, by the scans that show them [rad]
    contradictions: list[str]  # of the scans that contradict a parameter
    sizes: list[int]  # of the files that were written block by block [bytes]

    @classmethod
    def of(cls, results: Iterable[Segmentation]) -> Outcome:
        """Sum up scans, one by one."""
        found = cls(0, 0, [], [], [], [], [])
        for result in results:
            n_ground = int((result.label == Label.GROUND).sum())
            found = found._replace(
                n_points=found.n_points + len(result.label), n_ground=found.n_ground + n_ground
            )
            found.seconds.append(result.timings['total'])
            found.contradictions.extend(result.pose.contradictions)
            measured = result.pose.measured
            if measured is not None and measured.tells_height:
                found.heights.append(measured.height)
            if measured is not None and measured.tells_tilt:
                found.tilts.append((measured.roll, measured.pitch))
        return found


def pool(outcomes: Iterable[Outcome]) -> Outcome:
    """Put the scans of several outcomes together."""
    n_points, n_ground, *lists = zip(*outcomes, strict=True)
    return Outcome(sum(n_points), sum(n_ground), *([*itertools.chain(*parts)] for parts in lists))


def segment_block(
    write: Callable[[Path, Segmentation], int],
    target: Path,
    config: Config,
    scans: Sequence[Scan],
    progress: Progress,
) -> Outcome:
    """Label scans and write their files.

    `write` takes the path of a file and the `Segmentation`, and returns its size [bytes].
    """
    sizes = []

    def results(segmenter: GroundSegmenter) -> Iterator[Segmentation]:
        for scan in progress(scans):
            try:
                result = segmenter.segment(scan.read())
            except PointCloudError as error:
                raise PointCloudError(f'{scan.path}: {error}') from error
            sizes.append(write(target / scan.name, result))
            yield result

    return Outcome.of(results(GroundSegmenter(config)))._replace(sizes=sizes)


class Manifest:
    """What is finished: a line for each block, in a file in the output folder.

    It has for each scan the path, size and time of the input, and the size of the output. While it
    is in use it is locked, and nothing is written to it before `begin`.

    Parameters
    ----------
    folder : Path
        Output folder.
    configuration : str
        Digest of all that the output depends on, beside the inputs; see `digest`.
    scans : sequence of Scan
        All that are to be labelled.
    """

    def __init__(self, folder: Path, configuration: str, scans: Sequence[Scan]) -> None:
        self._path = folder / MANIFEST
        self._run = {'configuration': configuration, 'version': gp_ground_seg.__version__}
        self._inputs = {
            scan.name: [os.path.realpath(scan.path), *stamp(scan.path)] for scan in scans
        }
        self._text = b''
        self._file: IO[bytes] | None = None

    def open(self, *, resume: bool, force: bool) -> tuple[set[str], str]:
        """Lock the folder; return names of what is finished, and what is done again and why.

        Raises DataError if another run writes to the folder, with `resume` if it was begun with
        other parameters, and if it has output but neither `resume` nor `force` is given.
        """
        is_begun = self._path.exists()
        if is_begun:
            self._lock(0)
        sizes = self._output_sizes()
        if resume and is_begun:
            return self._compare(self._read(), sizes)
        if (sizes or is_begun) and not force:
            name = next(iter(sizes), MANIFEST)
            place = self._path.parent / name
            raise DataError(f'{place}: exists already; --resume continues, --force starts anew')
        return set(), ''

    def _lock(self, flags: int) -> None:
        """Open the file; the kernel frees its lock with the process, however that ends."""
        try:
            # Not by a link that someone else has planted.
            number = os.open(self._path, os.O_RDWR | os.O_NOFOLLOW | flags, 0o666)
            self._file = os.fdopen(number, 'rb+', buffering=0)
        except FileExistsError as error:
            raise DataError(f'{self._path.parent}: another run writes to it') from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataError(f'{self._path.parent}: another run writes to it') from error
        except OSError:
            _LOGGER.warning('%s: has no locks, start no other run', self._path.parent)

    def _read(self) -> dict[str, list[Any]]:
        """Return path, size and time of the input, and size of the output, by name."""
        text = read_bytes(self._path, _MAX_MANIFEST_BYTES)
        # The last line of a run that was killed may be cut off.
        self._text = text[: text.rfind(b'\n') + 1]
        found: dict[str, list[Any]] = {}
        for number, line in enumerate(self._text.splitlines(), 1):
            try:
                entry = json.loads(line)
                known = {key: entry[key] for key in self._run}
                found.update({name: list(about) for name, about in entry['items'].items()})
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                raise DataError(f'{self._path}: line {number} is none of a manifest') from error
            if known != self._run:
                was, now = (f'{d["configuration"]} of {d["version"]}' for d in (known, self._run))
                raise DataError(
                    f'{self._path}: was begun with the configuration {was}, this is {now}; give '
                    'the parameters of then, or another output folder'
                )
        return found

    def _compare(self, known: dict[str, list[Any]], sizes: dict[str, int]) -> tuple[set[str], str]:
        """Return the names of what is as it was, and how many are not, for each reason."""
        done, again = set[str](), dict[str, list[str]]()
        for name, given in self._inputs.items():
            if name not in known:
                continue
            *was, size = known[name] or [None]
            if was[:1] != given[:1]:
                again.setdefault('from another input', []).append(name)
            elif was != given:
                again.setdefault('with a changed input', []).append(name)
            elif sizes.get(name) != size:
                again.setdefault('with output missing or of another size', []).append(name)
            else:
                done.add(name)
        said = (f'{len(names)} {reason} ({names[0]})' for reason, names in again.items())
        return done, ', '.join(said)

    def _output_sizes(self) -> dict[str, int]:
        """Return the size of each file to write that is there [bytes]."""
        folders = {PurePosixPath(name).parent for name in self._inputs}
        there = {
            str(f / o.name): o for f in folders for o in (self._path.parent / str(f)).glob('*')
        }
        return {name: stamp(there[name])[0] for name in self._inputs if name in there}

    def begin(self) -> None:
        """Keep the whole lines that were read, none by default; what follows may write output."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if self._file is None:
            self._lock(os.O_CREAT | os.O_EXCL)
        assert self._file is not None
        self._file.truncate(len(self._text))
        self._file.seek(len(self._text))

    def add(self, names: Sequence[str], sizes: Sequence[int]) -> None:
        """Note that a block is finished, with the sizes of its outputs [bytes]."""
        items = {n: [*self._inputs[n], size] for n, size in zip(names, sizes, strict=True)}
        entry = {'block': self._text.count(b'\n'), 'items': items, **self._run}
        line = json.dumps(entry).encode() + b'\n'
        assert self._file is not None
        self._file.write(line)
        self._text += line

    def close(self) -> None:
        """Free the lock."""
        if self._file is not None:
            self._file.close()


def run_blocks(
    runner: Runner,
    function: Callable[[Config, Sequence[Scan], Progress], Outcome],
    config: Config,
    items: Sequence[Scan],
    manifest: Manifest,
    done: set[str],
    group: Callable[[Any], Hashable] | None,
) -> Outcome:
    """Compute the items whose names are not `done`, and add each block to the manifest.

    Blocks are cut by `group`, see `cut`.
    """
    left = [item for item in items if item.name not in done]
    blocks = cut(left, group, runner.n_workers)
    found = []
    for block, outcome in zip(blocks, runner.map(partial(function, config), blocks), strict=True):
        manifest.add([item.name for item in block], outcome.sizes)
        found.append(outcome)
    return pool(found)


def digest(config: Config, *more: object) -> str:
    """Digest of what labels depend on: the parameters, and `more`."""
    text = json.dumps([config.nested(), *map(repr, more)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def sweep(folder: Path, names: Iterable[str]) -> None:
    """Delete what killed workers left of the files `names`, all of which are finished."""
    for parent in {folder / Path(name).parent for name in names}:
        for left in parent.glob(f'.*{PARTIAL_MARK}*'):
            if left.is_file():
                left.unlink(missing_ok=True)
