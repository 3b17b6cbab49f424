"""The result of the demo in plain words."""

from __future__ import annotations

from gp_ground_seg.cli.demo_tally import Tally
from gp_ground_seg.cli.tables import milliseconds, percent


def thousands(number: int) -> str:
    """As in ``1 234 567``."""
    return f'{number:,}'.replace(',', ' ')


def result_text(tally: Tally, wanted_rate: float, truth: str) -> str:
    """Lay out the result.

    Parameters
    ----------
    tally : Tally
        What was counted.
    wanted_rate : float
        Scans per second that were to be played [Hz].
    truth : str
        Whose labels it was scored against.
    """
    rate = '-' if tally.rate is None else f'{tally.rate:.1f}'
    lines = [
        f'scans    {tally.n_sent} sent, {tally.n_back} back, {tally.n_lost} lost',
        f'points   {_partition(tally)}',
        f'labels   ground IoU {percent(tally.confusion.iou)} %, '
        f'precision {percent(tally.confusion.precision)} %, '
        f'recall {percent(tally.confusion.recall)} % (against {truth})',
        f'latency  median {milliseconds(tally.latency(50))} ms, '
        f'99 % within {milliseconds(tally.latency(99))} ms, '
        'from sending a scan to having both clouds',
        f'rate     {rate} scans per second came back, {wanted_rate:g} were wanted',
    ]
    return '\n'.join([*lines, *_failures(tally, wanted_rate)])


def _partition(tally: Tally) -> str:
    if tally.is_partition_exact:
        return (
            f'{thousands(tally.n_points)} of these scans: each is in exactly one of the '
            'two clouds, not a byte changed'
        )
    return (
        f'{thousands(tally.n_points)} of these scans: {thousands(tally.n_missing)} missing, '
        f'{thousands(tally.n_repeated)} more than once, {thousands(tally.n_altered)} changed, '
        f'{thousands(tally.n_foreign)} never sent; {tally.n_stray} clouds too many'
    )


def _failures(tally: Tally, wanted_rate: float) -> list[str]:
    lines = []
    if tally.n_lost:
        line = f'FAILED: {tally.n_lost} of {tally.n_sent} scans were lost'
        if tally.latency(50) > 1.0 / wanted_rate:
            line += '; this machine is too slow for that rate, try a lower --rate'
        lines.append(line)
    if not tally.is_partition_exact:
        lines.append('FAILED: the two clouds are not the scan that was sent; this is a bug')
    return lines
