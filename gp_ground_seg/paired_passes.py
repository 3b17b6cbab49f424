"""Two works in one call, so that other threads go on from one to the next without a pause.

To wake them takes a tenth of a millisecond, and the caller, which is in Python in between,
as long again.
"""

from __future__ import annotations

from typing import Any

from gp_ground_seg.compiled import compiled
from gp_ground_seg.face_passes import judge_faces
from gp_ground_seg.gp.growth_compiled import estimate_surface
from gp_ground_seg.instructions import look_at_row
from gp_ground_seg.label_passes import label_scan
from gp_ground_seg.meeting import GIVEN_UP, Board, enlist
from gp_ground_seg.point_passes import sort_points


@compiled
def sort_then_judge(
    share: int,
    n_shares: int,
    board: Board,
    sorting: tuple[Any, ...],
    judging: tuple[Any, ...],
) -> None:
    """Do `sort_points`, and unless the share is 0 `judge_faces`; see `Team.begin`."""
    share = enlist(board, share, n_shares)
    sort_points(share, n_shares, board, *sorting)
    if share > 0 and look_at_row(board, GIVEN_UP) == 0:
        judge_faces(share, n_shares, board, *judging)


@compiled
def estimate_then_label(
    share: int,
    n_shares: int,
    board: Board,
    estimating: tuple[Any, ...],
    labelling: tuple[Any, ...],
) -> None:
    """Do `estimate_surface`, and unless the share is 0 `label_scan`; see `Team.begin`."""
    share = enlist(board, share, n_shares)
    estimate_surface(share, n_shares, board, *estimating)
    if share > 0 and look_at_row(board, GIVEN_UP) == 0:
        label_scan(share, n_shares, board, *labelling)
