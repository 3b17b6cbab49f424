"""Which labelled frames a command works on."""

from __future__ import annotations

import argparse

from gp_ground_seg.cli.argument_types import positive
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.evaluation.evaluate import labelled_frames


def add_frame_options(parser: argparse.ArgumentParser) -> None:
    """Add ``ROOT``, ``--sequences LIST`` and ``--frame-step N``."""
    parser.add_argument('root', metavar='ROOT', help='folder in SemanticKITTI layout')
    parser.add_argument(
        '--sequences', metavar='LIST', help='sequences, as in 00,08 (default: all there are)'
    )
    parser.add_argument(
        '--frame-step', metavar='N', type=positive, default=1,
        help='every Nth frame of a sequence only',
    )  # fmt: skip


def frames_from_options(arguments: argparse.Namespace) -> list[Frame]:
    """Labelled frames asked for, grouped by sequence.

    Raises
    ------
    DataError
        As `labelled_frames`.
    """
    sequences = None
    if arguments.sequences is not None:
        sequences = [name for name in arguments.sequences.split(',') if name]
    grouped: dict[str, list[Frame]] = {}
    for frame in labelled_frames(arguments.root, sequences):
        grouped.setdefault(frame.sequence, []).append(frame)
    return [frame for group in grouped.values() for frame in group[:: arguments.frame_step]]
