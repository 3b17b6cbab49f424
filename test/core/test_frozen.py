"""Labels and p_ground of the 60 labelled frames, as they were when `frozen.json` was written.

`python test/core/test_frozen.py` writes it anew, after a change that is meant to change results.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import find_kitti

from gp_ground_seg import Config, GroundSegmenter, Segmentation
from gp_ground_seg.data.cloud_files import read_file

pytestmark = pytest.mark.usefixtures('compiled_code')

FROZEN = Path(__file__).with_name('frozen.json')
SAME_P_GROUND = 1e-5
"""Difference of the mean p_ground of a frame that other processors make, with room to spare."""
SAME_HEIGHT = 1e-5
"""Difference of heights by the single precision of compiled code [m]."""
MAX_LABELS_BY_NUMPY = 2
"""Points of a frame that rounding labels differently in the two backends, as docs/performance.md
says."""


def segmented(folder: Path, **changes: object) -> Iterator[tuple[str, Segmentation]]:
    """Name and result of each frame."""
    segmenter = GroundSegmenter(Config().replace(**changes))
    for path in sorted(folder.glob('sequences/*/velodyne/*.bin')):
        yield f'{path.parts[-3]}/{path.stem}', segmenter.segment(read_file(path).xyz)


def summaries(folder: Path, **changes: object) -> dict[str, dict]:
    """Summary of each frame, by its name."""
    return {
        name: {
            'labels': hashlib.sha256(result.label.tobytes()).hexdigest()[:16],
            'p_ground': float(np.nanmean(result.p_ground, dtype=np.float64)),
        }
        for name, result in segmented(folder, **changes)
    }


def test_labels_and_p_ground_are_as_frozen(kitti):
    frozen = json.loads(FROZEN.read_text())
    found = summaries(kitti, **{'runtime.backend': 'numba'})
    assert len(found) == 60
    for name, summary in found.items():
        assert summary['labels'] == frozen[name]['labels'], name
        assert summary['p_ground'] == pytest.approx(frozen[name]['p_ground'], abs=SAME_P_GROUND)


@pytest.mark.slow
def test_numpy_gives_the_same_but_for_rounding(kitti):
    by_backend = (segmented(kitti, **{'runtime.backend': name}) for name in ('numba', 'numpy'))
    n_different = {}
    for (name, fast), (_, slow) in zip(*by_backend, strict=True):
        n_different[name] = int(np.count_nonzero(fast.label != slow.label))
        for value in ('ground_z', 'ground_std', 'return_std'):
            pair = getattr(fast, value), getattr(slow, value)
            is_same = np.isclose(*pair, rtol=0, atol=SAME_HEIGHT, equal_nan=True)
            assert is_same.mean() > 0.995, (name, value)
    assert len(n_different) == 60
    assert max(n_different.values()) <= MAX_LABELS_BY_NUMPY, n_different


if __name__ == '__main__':
    kitti_folder = find_kitti()
    assert kitti_folder is not None
    FROZEN.write_text(json.dumps(summaries(kitti_folder), indent=1) + '\n')
