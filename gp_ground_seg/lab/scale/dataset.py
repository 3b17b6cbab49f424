"""Label files of whole data sets, block by block, and a record of the blocks that are finished."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gp_ground_seg
from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.atomic_output import PARTIAL_MARK
from gp_ground_seg.data.files import AnyPath, UrlPath, read_bytes, write_file
from gp_ground_seg.lab.scale.cluster import Progress, Runner, cut, depends_on_past

MANIFEST = 'manifest.jsonl'
_MAX_MANIFEST_BYTES = 1 << 32


class Scan(NamedTuple):
    """A scan to label."""

    path: AnyPath
    name: str  # of the file to write, below the output folder
    sequence: str  # labels may depend on the scans before it in the same sequence
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

    @classmethod
    def of(cls, results: Iterable[Segmentation]) -> Outcome:
        """Sum up scans, one by one."""
        found = cls(0, 0, [], [], [], [])
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
    write: Callable[[AnyPath, Segmentation], None],
    target: AnyPath,
    config: Config,
    scans: Sequence[Scan],
    progress: Progress,
) -> Outcome:
    """Label scans of one sequence, or of several where none depends on another; write the files.

    `write` takes the path of a file and the `Segmentation`.
    """

    def results(segmenter: GroundSegmenter) -> Iterator[Segmentation]:
        sequence = None
        for scan in progress(scans):
            if scan.sequence != sequence:
                segmenter.reset()
            sequence = scan.sequence
            try:
                result = segmenter.segment(scan.read())
            except PointCloudError as error:
                raise PointCloudError(f'{scan.path}: {error}') from error
            write(target / scan.name, result)
            yield result

    with GroundSegmenter(config) as segmenter:
        return Outcome.of(results(segmenter))


class Manifest:
    """Names of what is finished, a line for each block, in a file in the output folder.

    Parameters
    ----------
    folder : path or URL
        Output folder.
    configuration : str
        Digest of all that the output depends on; see `digest`.
    """

    def __init__(self, folder: AnyPath, configuration: str) -> None:
        self._path = folder / MANIFEST
        self._run = {'configuration': configuration, 'version': gp_ground_seg.__version__}
        self._text = b''

    def resume(self) -> set[str] | None:
        """Return what is finished, None if nothing was begun; DataError for other parameters."""
        if not self._path.exists():
            return None
        text = read_bytes(self._path, _MAX_MANIFEST_BYTES)
        # The last line of a run that was killed may be cut off.
        self._text = text[: text.rfind(b'\n') + 1]
        names: set[str] = set()
        for number, line in enumerate(self._text.splitlines(), 1):
            try:
                entry = json.loads(line)
                known = {key: entry[key] for key in self._run}
                names.update(entry['names'])
            except (ValueError, KeyError, TypeError) as error:
                raise DataError(f'{self._path}: line {number} is none of a manifest') from error
            if known != self._run:
                was, now = (f'{d["configuration"]} of {d["version"]}' for d in (known, self._run))
                raise DataError(
                    f'{self._path}: was begun with the configuration {was}, this is {now}; give '
                    'the parameters of then, or another output folder'
                )
        write_file(self._path, self._text)
        return names

    def begin(self, names: Iterable[str], *, force: bool) -> None:
        """Begin anew; DataError if one of the files `names` exists and `force` is false."""
        folder = self._path.parent
        parents = {str(Path(name).parent) for name in names}
        there = {f'{p}/{f.name}' for p in parents for f in (folder / p).glob('*')}
        existing = [name for name in names if name in there or f'./{name}' in there]
        if (existing or self._path.exists()) and not force:
            name = existing[0] if existing else MANIFEST
            raise DataError(
                f'{folder / name}: exists already; --resume continues, --force starts anew'
            )
        write_file(self._path, b'')

    def add(self, names: Sequence[str]) -> None:
        """Note that a block is finished."""
        entry = {'block': self._text.count(b'\n'), 'names': list(names), **self._run}
        line = json.dumps(entry).encode() + b'\n'
        self._text += line
        if isinstance(self._path, UrlPath):  # An object cannot be appended to.
            self._path.write_bytes(self._text)
            return
        with self._path.open('ab') as file:
            file.write(line)


def run_blocks(
    runner: Runner,
    function: Callable[[Config, Sequence[Scan], Progress], Outcome],
    config: Config,
    items: Sequence[Scan],
    manifest: Manifest,
    done: set[str],
    by_sequence: bool = False,
) -> Outcome:
    """Compute the items whose names are not `done`, and add each block to the manifest.

    With `by_sequence`, or where the labels of a scan depend on the scans before it, a block is a
    whole sequence, computed again from its first scan if it is not finished.
    """
    left = [item for item in items if item.name not in done]
    if runner.n_workers:
        config = config.replace(**{'runtime.n_threads': 1})
    if by_sequence or depends_on_past(config):
        unfinished = {item.sequence for item in left}
        again = [item for item in items if item.sequence in unfinished]
        blocks = cut(again, lambda item: item.sequence)
    else:
        blocks = cut(left, None, runner.n_workers)
    found = []
    for k, outcome in runner.map_blocks(partial(function, config), blocks):
        manifest.add([item.name for item in blocks[k]])
        found.append(outcome)
    return pool(found)


def digest(config: Config, *more: object) -> str:
    """Digest of what labels depend on: parameters but for the number of threads, and `more`."""
    nested = config.replace(**{'runtime.n_threads': 1}).nested()
    text = json.dumps([nested, *map(repr, more)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def sweep(folder: Path, names: Iterable[str]) -> None:
    """Delete what killed workers left of the files `names`, all of which are finished."""
    for parent in {folder / Path(name).parent for name in names}:
        for left in parent.glob(f'.*{PARTIAL_MARK}*'):
            if left.is_file():
                left.unlink(missing_ok=True)
