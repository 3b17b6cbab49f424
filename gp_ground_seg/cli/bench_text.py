"""A benchmark as text, for the terminal and for docs/performance.md."""

from __future__ import annotations

import textwrap
from typing import Any

from gp_ground_seg.cli.evaluation_text import PEER_TITLES, WIDTH
from gp_ground_seg.cli.tables import format_table
from gp_ground_seg.errors import DataError

DOCS_BEGIN = '<!-- bench:begin -->'
DOCS_END = '<!-- bench:end -->'

_SERIES = {
    'points': 'points',
    'segments': 'segments (grid.n_segments)',
    'bins': 'bins of a segment (grid.n_bins)',
    'pseudo_inputs': 'pseudo-inputs of the frame (latent.candidates_per_pseudo_input)',
}


def bench_text(document: dict[str, Any]) -> str:
    """Lay out a report of `gp_ground_seg.evaluation.bench_report` as tables."""
    parts = [_headline(document), _case_table(document), _stage_table(document)]
    if document['merged']:
        parts.append(_merged_line(document['merged']))
    parts += [_scaling_table(name, found) for name, found in document['scaling'].items()]
    parts.append(_footer(document))
    return '\n\n'.join(parts)


def replace_section(text: str, document: dict[str, Any]) -> str:
    """Put the tables between the markers of a Markdown file.

    Raises
    ------
    DataError
        If the two markers are not there once each, in order.
    """
    head, begin, rest = text.partition(DOCS_BEGIN)
    middle, end, tail = rest.partition(DOCS_END)
    if not begin or not end or any(m in middle + tail for m in (DOCS_BEGIN, DOCS_END)):
        raise DataError(
            f'must hold the lines {DOCS_BEGIN} and {DOCS_END} once each, in this order; '
            'the tables go between them'
        )
    return f'{head}{begin}\n\n```text\n{bench_text(document)}\n```\n\n{end}{tail}'


def _headline(document: dict[str, Any]) -> str:
    points = document['n_points']
    return (
        f'{document["n_frames"]} frames of {document["data"]}, {_thousands(points["median"])} '
        f'points (median), at most {_thousands(points["max"])}'
    )


def _case_table(document: dict[str, Any]) -> str:
    yardstick = document['yardstick']
    header = ['time per frame, reading left out', 'median [ms]', 'p99 [ms]']
    rows = [
        [case['name'], f'{case["ms"]["median"]:.2f}', f'{case["ms"]["p99"]:.2f}']
        for case in document['cases']
    ]
    if yardstick:
        peer = document['yardstick_ms']
        title = PEER_TITLES.get(yardstick, yardstick)
        header += [f'/ {title}', 'p99 / its median']
        for row, case in zip(rows, document['cases'], strict=True):
            row += [f'{case["ratio"]["median"]:.2f}', f'{case["ratio"]["p99"]:.2f}']
        rows.append(
            [title, f'{peer["median"]:.2f}', f'{peer["p99"]:.2f}', '1',
             f'{peer["p99"] / peer["median"]:.2f}']
        )  # fmt: skip
        return format_table(header, rows, rule_before=len(rows) - 1)
    return format_table(header, rows)


def _stage_table(document: dict[str, Any]) -> str:
    stages = list(document['cases'][0]['stages_ms'])
    rows = [
        [case['name'], *(f'{case["stages_ms"][stage]:.2f}' for stage in stages)]
        for case in document['cases']
    ]
    return format_table(['stage, median [ms]', *stages], rows)


def _merged_line(merged: dict[str, Any]) -> str:
    return '\n'.join(
        textwrap.wrap(
            f'four frames merged ({_thousands(merged["n_points"])} points), theta fixed, '
            f'1 thread: {merged["ms"]:.2f} ms, {merged["ratio_to_single"]:.2f} times one of '
            f'them ({merged["n_clouds"]} clouds)',
            WIDTH,
        )
    )


def _scaling_table(series: str, found: list[dict[str, Any]]) -> str:
    rows = [
        [
            _thousands(point['size']),
            f'{point["ms"]["fixed"]:.2f}',
            f'{point["ratio_to_default"]["fixed"]:.2f}',
            f'{point["ms"]["every_frame"]:.2f}',
            f'{point["ratio_to_default"]["every_frame"]:.2f}',
        ]
        for point in found
    ]
    header = ['1 thread', 'theta fixed [ms]', '/ default', 'learning [ms]', '/ default']
    return f'{_SERIES[series]}\n{format_table(header, rows, n_left=0)}'


def _footer(document: dict[str, Any]) -> str:
    environment = document['environment']
    versions = ', '.join(
        f'{name} {version or "absent"}' for name, version in environment['versions'].items()
    )
    changes = ', '.join(f'{name}={value}' for name, value in document['config_changes'].items())
    lines = (
        f'parameters: {changes or "defaults"}',
        f'machine: {environment["cpu"]}, {environment["n_cores"]} cores for this process',
        f'versions: Python {environment["python"]}, {versions}',
        f'commit: {environment["commit"] or "unknown"}',
    )
    return '\n'.join(
        textwrap.fill(line, WIDTH, subsequent_indent='  ', break_on_hyphens=False)
        for line in lines
    )


def _thousands(number: float) -> str:
    return f'{round(number):,}'.replace(',', ' ')
