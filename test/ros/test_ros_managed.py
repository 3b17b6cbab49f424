"""The managed node, driven by the services that ``ros2 lifecycle`` and Nav2's manager call."""

import importlib.util
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import ros_helpers as ros
from cli_runner import children
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ros_helpers import street, to_message, wait_for

from gp_ground_seg.core.backend import choose_backend
from gp_ground_seg.core.jit import HAVE_NUMBA
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.ros.loader import FOLLOWS

pytestmark = pytest.mark.usefixtures('compiled_code')

HAS_NO_BOND = importlib.util.find_spec('bond') is None
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE, SHUTDOWN = 1, 2, 3, 4, 5
"""Numbers of `lifecycle_msgs`: states, and transitions; 5 to 7 end each of the first states."""
AT_ONCE = 2.5  # longest time to an answer [s]


@pytest.fixture
def link(tmp_path):
    """A `Link` to the process of a node, which ends without an error."""
    limits = {'diagnostics.stale_after': 0.5}
    with ros.linked_process(tmp_path, limits, connected=False, start=ros.MANAGED) as (node, link):
        link.process = node
        yield link
        if node.popen.returncode is None:
            node.end_well()
        # What it offers ends with it, and is not listed for the 20 s of a lease.
        service = f'{link.node_name}/get_state'
        assert any(time.sleep(0.1) or not link.probe.count_services(service) for _ in range(100))


def change(link, number=0, label=''):
    """Whether the node has made the transition, at once, and its state after it."""
    request = ChangeState.Request(transition=Transition(id=number, label=label))
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(link.call, ChangeState, 'change_state', request)
        state = pool.submit(link.call, GetState, 'get_state', GetState.Request())
        assert link.process.time_of(state.done, 'state') < AT_ONCE
    return answer.result().success, state.result().current_state.id


def test_the_transitions_compile_listen_and_free(link):
    message = to_message(street(3000))
    status = link.wait_for_status('input', lambda v, _: v['Publishers'] == '1')
    assert 'not listening to' in status.message and status.level == b'\0'
    assert not link.set('label.ground_tolerance', 0.12)
    assert FOLLOWS not in link.process.log
    for numbers in (('1', '2'), ('3',)):
        assert change(link, CONFIGURE) == (True, INACTIVE)
        for n in numbers:
            wait_for(lambda: not link.publisher.get_subscription_count(), 'no subscription')
            assert change(link, ACTIVATE) == (True, ACTIVE)
            link.wait_until_connected()
            assert sum(cloud.width for cloud in link.segment(message)) == 3000
            status = link.wait_for_status(
                'processing', lambda v, _, n=n: v['Clouds since startup'] == n
            )
            link.process.wait_until_settled()
            assert n != '2' or ros.values_of(status)['Backend'] == choose_backend('auto')
            assert change(link, DEACTIVATE) == (True, INACTIVE)
        assert change(link, CLEANUP) == (True, UNCONFIGURED)
    assert change(link, SHUTDOWN) == (True, FINALIZED)


@pytest.mark.skipif(HAS_NO_BOND, reason='package bond is not installed')
def test_a_lifecycle_manager_hears_a_bond_while_the_node_is_active(link):
    from bond.msg import Status

    heard, instances = ros.Collector(link.probe, Status, 'bond'), set()
    change(link, CONFIGURE)
    assert not heard.messages

    def is_regular():
        times = [one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec for one in heard.messages]
        return len(times) > 2 and np.median(np.diff(times)) == pytest.approx(0.1, abs=0.05)

    for n, end in enumerate((lambda: change(link, DEACTIVATE), link.process.end_well), 1):
        heard.messages.clear()
        change(link, ACTIVATE)
        # Nav2's manager waits half of its bond_timeout for the first that it hears.
        wait_for(is_regular, 'heartbeat every 0.1 s')
        end()
        wait_for(lambda: not heard.messages[-1].active, 'end of the bond')
        *beats, last = heard.messages
        assert all(beat.active for beat in beats)
        assert {one.id for one in heard.messages} == {NODE_NAME}
        instances |= {one.instance_id for one in heard.messages}
        assert len(instances) == n
        assert last.heartbeat_period == pytest.approx(0.1) and last.heartbeat_timeout == 4.0
    assert 'bond_timeout' not in link.process.log


def test_impossible_transitions_are_refused_at_once(link):
    # What is possible in a state, the transition that the test takes first.
    possible = {
        UNCONFIGURED: (CONFIGURE, SHUTDOWN), INACTIVE: (ACTIVATE, CLEANUP, 6),
        ACTIVE: (7, DEACTIVATE), FINALIZED: (),
    }  # fmt: skip
    for state, numbers in possible.items():
        for number in {*range(12), *range(60, 70), 99, 255}.difference(numbers):
            assert change(link, number) == (False, state), (state, number)
        for label in ('create', 'activate', 'nonsense\n'):
            assert (state, label) == (INACTIVE, 'activate') or not change(link, label=label)[0]
        if state == ACTIVE:
            link.wait_until_connected()
            assert sum(cloud.width for cloud in link.segment(to_message(street(500)))) == 500
        assert state == FINALIZED or change(link, numbers[0])[0]
    is_said = 'set bond_timeout: 0.0' in link.process.log
    assert is_said == HAS_NO_BOND
    refused = [line for line in link.process.log.splitlines() if ' refused: ' in line]
    assert refused and '[WARN]' in refused[0]
    assert 'refused: it is not possible in the present state' in refused[0]


@pytest.mark.slow
@pytest.mark.skipif(not HAVE_NUMBA, reason='numba is not installed')
def test_a_node_that_compiles_answers_and_ends_at_a_signal(tmp_path, monkeypatch, request):
    cache = tmp_path / 'cache'
    cache.mkdir(mode=0o700)
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(cache))
    link = request.getfixturevalue('link')
    assert change(link, CONFIGURE) == (True, INACTIVE) and change(link, ACTIVATE) == (True, ACTIVE)
    wait_for(lambda: children(link.process.popen.pid), 'compiler')
    link.wait_until_connected()
    assert sum(cloud.width for cloud in link.segment(to_message(street(3000)))) == 3000
    (compiler,) = children(link.process.popen.pid)
    niceness = os.getpriority(os.PRIO_PROCESS, link.process.popen.pid)
    wait_for(lambda: os.getpriority(os.PRIO_PROCESS, compiler) > niceness, 'niceness')
    link.process.end_well(signal.SIGTERM)
    assert 'ends: 1 clouds segmented, 0 lost' in link.process.log
