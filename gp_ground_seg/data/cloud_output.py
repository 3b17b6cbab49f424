"""Files of labelled clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.cloud_files import WRITABLE, encode_file
from gp_ground_seg.data.clouds import Cloud

LABELS = 'label'
FORMATS = (LABELS, *(suffix[1:] for suffix in WRITABLE))
# Unlabelled, road and other-object.
SEMANTIC_KITTI_CODE = {Label.UNKNOWN: 0, Label.GROUND: 40, Label.OBSTACLE: 99}
_VALUES = ('height', 'ground_z', 'ground_std', 'p_ground')


def format_for(path: Path, wanted: str | None) -> str:
    """One of `FORMATS` for the output of a scan: by default its own, and labels of ``.bin``."""
    suffix = path.suffix.lower()[1:]
    return wanted or (suffix if suffix in FORMATS else LABELS)


def encode_output(path: Path, cloud: Cloud, result: Segmentation) -> bytes:
    """File of a cloud with its labels, of the format of `path`; DataError if none can be.

    A ``.label`` has a uint32 for each point, SemanticKITTI's code. Other files have every field of
    the cloud, label and values of each point.
    """
    if path.suffix[1:] == LABELS:
        codes = [SEMANTIC_KITTI_CODE[k] for k in sorted(Label)]
        return np.array(codes, dtype='<u4')[result.label].tobytes()
    values = {name: getattr(result, name).astype(np.float32) for name in _VALUES}
    return encode_file(path, cloud, {'label': result.label, **values})
