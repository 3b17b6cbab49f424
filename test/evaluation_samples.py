"""Small SemanticKITTI folders, and a method whose scores are known by hand."""

from pathlib import Path

import numpy as np

from gp_ground_seg.core.frame import Label
from gp_ground_seg.lab.scoring.evaluate import MethodResult, Scores, make_scores


def scores_of(**methods: list[dict]) -> Scores:
    """Scores by rows of scans of each method; rows say sequence, index and cluster."""
    common = {'n_scans': 1, 'seconds': 0.0, 'points': 100, 'n_changed': 0, 'backend': 'numba'}
    rows = [
        {'method': name, 'cluster': row['sequence'], **common, **row}
        for name, its in methods.items()
        for row in its
    ]
    return make_scores([{'scans': rows}])


def street(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A level road with a wall, a tree, low grass and an outlier: points (N, 4), classes (N,)."""
    rng = np.random.default_rng(seed)

    def block(n, low, high, semantic):
        xyz = rng.uniform(low, high, (n, 3))
        return np.column_stack([xyz, rng.uniform(0, 1, n)]), np.full(n, semantic)

    parts = [
        block(4000, (-30, -20, -1.75), (30, 20, -1.71), 40),
        block(900, (15, -20, -1.6), (15.3, 20, 1.5), 50),
        block(300, (-8, 6, -0.5), (-5, 9, 2.0), 70),
        block(200, (-8, 6, -1.72), (-5, 9, -1.65), 70),
        block(50, (3, 3, -1.75), (4, 4, -1.71), 0),
        block(5, (3, 3, 5), (4, 4, 9), 1),
    ]
    points = np.concatenate([p for p, _ in parts]).astype('<f4')
    return points, np.concatenate([c for _, c in parts]).astype('<u4')


def write_frame(root: Path, sequence: str, index: int, points: np.ndarray, semantic=None) -> None:
    """Write one frame; `semantic` None leaves it without labels."""
    folder = root / 'sequences' / sequence
    for name, ending, data in (('velodyne', 'bin', points), ('labels', 'label', semantic)):
        (folder / name).mkdir(parents=True, exist_ok=True)
        if data is not None:
            (folder / name / f'{index:06d}.{ending}').write_bytes(data.tobytes())


def write_streets(root: Path, **n_frames: int) -> Path:
    """Write sequences of streets: ``write_streets(root, s00=2)`` makes two frames of 00."""
    for name, n in n_frames.items():
        for k in range(n):
            points, semantic = street(seed=k)
            # An instance number in the upper half, as in the real files.
            write_frame(root, name.removeprefix('s'), k, points, semantic | np.uint32(7 << 16))
    return root


class HeightRule:
    """Ground is below a fixed height: a method simple enough to know its scores by hand.

    The journal gets its name for each run and an R before it for each reset.
    """

    depends_on_past = False

    def __init__(self, name: str, height: float, journal: list | None = None) -> None:
        self.name = name
        self.height = height
        self.journal = [] if journal is None else journal

    def reset(self, scan) -> None:
        self.journal.append(f'R{self.name}')

    def run(self, points: np.ndarray) -> None:
        self.journal.append(self.name)
        self.points = points

    def result(self) -> MethodResult:
        label = np.where(self.points[:, 2] < self.height, Label.GROUND, Label.OBSTACLE)
        surface = np.full(len(self.points), self.height)
        return MethodResult(label.astype(np.uint8), surface)


def label_files(folder):
    """Label files below a folder, by path; None for a link to nowhere."""
    return {
        str(file.relative_to(folder)): file.read_bytes() if file.exists() else None
        for file in sorted(Path(folder).rglob('*.label'))
    }
