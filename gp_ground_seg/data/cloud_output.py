"""Files for each segmented cloud: labels, the points with their results, the ground as a grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.atomic_output import staged_file, staged_files
from gp_ground_seg.data.cloud_files import WRITABLE, encode_arrays, encode_file
from gp_ground_seg.data.clouds import Cloud, Columns
from gp_ground_seg.data.inputs import Input, Inputs

LABELS = 'label'
FORMATS = (LABELS, *(suffix[1:] for suffix in WRITABLE))
CELL = 0.5
"""Side of the cells of a written surface [m]."""
# Unlabelled, road and other-object.
SEMANTIC_KITTI_CODE = {Label.UNKNOWN: 0, Label.GROUND: 40, Label.OBSTACLE: 99}
PARTS = {'_ground': Label.GROUND, '_obstacles': Label.OBSTACLE}


@dataclass(frozen=True)
class CloudOutput:
    """Files to write for each cloud.

    Attributes
    ----------
    form : str or None
        One of `FORMATS`; None: labels of a ``.bin`` scan, else the input's format.
    split : bool
        Whether ground and obstacles are written into separate files.
    surface : bool
        Whether the ground is written as a grid as well.
    """

    form: str | None = None
    split: bool = False
    surface: bool = False

    def names(self, scan: Input, stem: str | None = None) -> list[str]:
        """Names of the files of a cloud, which begin with `stem`, by default its name."""
        stem, form = stem or scan.name, self._form(scan)
        if self.split and form == LABELS:
            raise DataError('--split: is for clouds, a .label file has both; see --format')
        parts = PARTS if self.split else ['']
        surface = [f'{stem}_surface.npz'] if self.surface else []
        return [*(f'{stem}{part}.{form}' for part in parts), *surface]

    def _form(self, scan: Input) -> str:
        suffix = scan.path.suffix.lower()[1:]
        return self.form or (suffix if suffix in FORMATS else LABELS)

    @contextmanager
    def staged(
        self, scans: Inputs, target: Path, *, is_file: bool, force: bool
    ) -> Iterator[Callable[[Input], list[Path]]]:
        """Yield a function of a scan that returns where to write its files.

        All files take their names below `target`, or beside it if it is the file of a single
        scan, when the block ends well. Raises DataError if one of them is an input, or exists and
        `force` is false.
        """
        folder, stem = (target.parent, target.stem) if is_file else (target, None)
        names = [name for scan in scans for name in self.names(scan, stem)]
        inputs = {scan.path.resolve() for scan in scans}
        for name in names:
            if (folder / name).resolve() in inputs:
                raise DataError(f'{folder / name}: is the input; name another output')
        with ExitStack() as stack:
            if is_file:
                paths = [stack.enter_context(staged_file(folder / n, force=force)) for n in names]
                yield lambda _: paths
            else:
                hidden = stack.enter_context(staged_files(folder, names, force=force))
                yield lambda scan: [hidden / name for name in self.names(scan)]

    def write(
        self, scan: Input, segmenter: GroundSegmenter, paths: Sequence[Path]
    ) -> Segmentation:
        """Segment a cloud and write its files, to `paths` in the order of `names`."""
        cloud = scan.read()
        try:
            result = segmenter.segment(cloud.xyz)
        except PointCloudError as error:
            raise PointCloudError(f'{scan.path}: {error}') from error
        if self._form(scan) == LABELS:
            paths[0].write_bytes(encode_labels(result))
        else:
            values = _results(result, cloud)
            for path, part in zip(paths, PARTS.values() if self.split else [None], strict=False):
                mask = (result.label == part) | (part is None)
                columns = {name: column[mask] for name, column in values.items()}
                path.write_bytes(encode_file(path, cloud.take(mask), columns))
        if self.surface:
            paths[-1].write_bytes(_encode_surface(result, cloud))
        return result


def encode_labels(result: Segmentation) -> bytes:
    """File of a uint32 for each point, SemanticKITTI's code."""
    codes = [SEMANTIC_KITTI_CODE[k] for k in sorted(Label)]
    return np.array(codes, dtype='<u4')[result.label].tobytes()


def _results(result: Segmentation, cloud: Cloud) -> Columns:
    """Label and values of each point, in the coordinates of the file."""
    values: Columns = {
        'height': result.height,
        'ground_z': result.ground_z,
        'ground_std': result.ground_std,
        'p_ground': result.p_ground,
    }
    return {
        'label': result.label,
        **{name: column.astype(np.float32) for name, column in values.items()},
    }


def _encode_surface(result: Segmentation, cloud: Cloud) -> bytes:
    """File of the ground around the sensor as a grid, in the coordinates of the file [m].

    Arrays x (W,), y (H,), ground_z and ground_std (H, W) float32, NaN where there is no model.
    """
    model = GroundModel.of(result)
    reach = CELL * np.ceil(model.knots[-1] / CELL)
    middle = np.arange(0.5 * CELL - reach, reach, CELL)
    z, std = model.at(middle, middle[:, None])
    grids = {'ground_z': z.astype(np.float32), 'ground_std': std.astype(np.float32)}
    return encode_arrays({'x': middle, 'y': middle, **grids})
