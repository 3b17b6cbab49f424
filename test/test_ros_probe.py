"""Losses and latency, from times."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.ros.probe import Trip, rate_result


def trips_of(latencies, period=0.1):
    """Trips of clouds sent every `period`, None = lost."""
    start = 1_700_000_000 * 10**9
    sent = [start + round(1e9 * period * k) for k in range(len(latencies))]
    return [
        Trip(t, None if latency is None else t + round(1e9 * latency))
        for t, latency in zip(sent, latencies, strict=True)
    ]


@given(st.lists(st.none() | st.floats(0.0, 5.0), min_size=2))
def test_counts_and_percentiles(latencies):
    result = rate_result(10.0, trips_of(latencies))
    back = [latency for latency in latencies if latency is not None]
    assert (result['n_sent'], result['n_back']) == (len(latencies), len(back))
    assert result['n_lost'] == latencies.count(None)
    assert result['sent'] == pytest.approx(10.0)
    if back:
        expected = np.percentile(back, [50, 95, 99, 100])
        found = [result['p50'], result['p95'], result['p99'], result['worst']]
        np.testing.assert_allclose(found, expected, atol=1e-8)
    else:
        assert math.isnan(result['p50'])
