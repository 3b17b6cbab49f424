"""What ``node-bench`` found, as a document and as text, and the goals it is held against."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from gp_ground_seg.cli.tables import format_table, milliseconds
from gp_ground_seg.evaluation.environment import Environment
from gp_ground_seg.evaluation.trips import MemoryResult, RateResult

LOSSLESS_RATE = 20.0
"""Up to this rate nothing may be lost [Hz]."""
PUNCTUAL_RATE = 10.0
"""Up to this rate the 99th percentile of latency has a limit [Hz]."""
MAX_P99 = 0.1
"""That limit [s]."""
MAX_PEAK = 350e6
"""Limit of memory [bytes]."""
MAX_GROWTH = 0.02
"""Limit of its growth [1]."""


def document_of(
    rates: Sequence[RateResult],
    memory: MemoryResult | None,
    source: dict[str, Any],
    environment: Environment,
) -> dict[str, Any]:
    """Return all numbers as a document for JSON; times in seconds, memory in bytes."""
    return {
        'source': source,
        'rates': [
            {
                **_finite(dataclasses.asdict(rate)),
                'n_lost': rate.n_lost,
                'is_accounted': rate.is_accounted,
                'goals': _rate_goals(rate),
            }
            for rate in rates
        ],
        'memory': None
        if memory is None
        else {
            **dataclasses.asdict(memory),
            'growth': memory.growth,
            'goals': {
                f'peak below {MAX_PEAK / 1e6:.0f} MB': memory.peak < MAX_PEAK,
                f'growth at most {MAX_GROWTH:.0%}': memory.growth <= MAX_GROWTH,
            },
        },
        'environment': dataclasses.asdict(environment),
    }


def _rate_goals(rate: RateResult) -> dict[str, bool]:
    goals = {
        'newest cloud back': rate.is_newest_back,
        'losses reported': rate.is_accounted,
        'latency bounded': rate.is_bounded,
    }
    if rate.asked <= LOSSLESS_RATE:
        goals['nothing lost'] = rate.n_lost == 0
    if rate.asked <= PUNCTUAL_RATE:
        goals[f'p99 at most {1e3 * MAX_P99:.0f} ms'] = rate.p99 <= MAX_P99
    return goals


def goals_missed(document: dict[str, Any]) -> list[str]:
    """Return the goals that were missed, with where."""
    missed = [
        f'{rate["asked"]:g} Hz: {goal}'
        for rate in document['rates']
        for goal, met in rate['goals'].items()
        if not met
    ]
    if document['memory'] is not None:
        missed += [
            f'memory: {goal}' for goal, met in document['memory']['goals'].items() if not met
        ]
    return missed


def node_bench_text(document: dict[str, Any]) -> str:
    """Return the document as tables."""
    source, environment = document['source'], document['environment']
    parts = [
        f'{source["data"]}: {source["title"]} of {source["mean_points"]:.0f} points, '
        f'{source["mean_bytes"] / 1e6:.2f} MB, on average\n'
        f'{environment["cpu"]}, {environment["n_cores"]} cores'
    ]
    header = (
        'Rate [Hz]', 'sent [Hz]', 'sent', 'back', 'lost', 'reported',
        'p50 [ms]', 'p95', 'p99', 'worst',
    )  # fmt: skip
    rows = [
        (
            f'{rate["asked"]:g}',
            '-' if rate['sent'] is None else f'{rate["sent"]:.2f}',
            str(rate['n_sent']),
            str(rate['n_back']),
            str(rate['n_lost']),
            str(rate['n_dropped']),
            *(
                milliseconds(math.nan if rate[key] is None else rate[key])
                for key in ('p50', 'p95', 'p99', 'worst')
            ),
        )
        for rate in document['rates']
    ]
    parts.append(format_table(header, rows))
    memory = document['memory']
    if memory is not None:
        parts.append(
            f'Memory over {memory["n_clouds"]} clouds: {memory["start"] / 1e6:.1f} MB near the '
            f'start, {memory["end"] / 1e6:.1f} MB at the end ({memory["growth"]:+.2%}); '
            f'peak {memory["peak"] / 1e6:.1f} MB'
        )
    missed = goals_missed(document)
    parts.append('Goals missed: ' + '; '.join(missed) if missed else 'All goals met.')
    return '\n\n'.join(parts)


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in values.items()
    }
