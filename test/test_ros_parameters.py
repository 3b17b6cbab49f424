"""Parameters of the node through its ROS services, and at its start."""

import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy', reason='ROS is not installed')

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from ros_helpers import (
    bench,
    isolated_context,
    parameter_message,
    spinning,
    street,
    to_message,
    wait_for,
    xyz_of,
)

from gp_ground_seg import Config, ConfigError, GroundSegmenter, Label
from gp_ground_seg.parameters.config import find_spec, parameter_specs
from gp_ground_seg.ros.node import GroundSegmentationNode

TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}


def values_of(b):
    names = [spec.name for spec in parameter_specs()]
    response = b.call(GetParameters, 'get_parameters', GetParameters.Request(names=names))
    values = [parameter_value_to_python(value) for value in response.values]
    return dict(zip(names, values, strict=True))


def n_ground(points, **changes):
    config = Config().replace(**changes)
    label = GroundSegmenter(config).segment(xyz_of(points)).label
    return int((label == Label.GROUND).sum())


def test_every_parameter_is_described_with_type_range_unit_and_symbol():
    specs = parameter_specs()
    with bench() as b:
        request = DescribeParameters.Request(names=[spec.name for spec in specs])
        descriptors = b.call(DescribeParameters, 'describe_parameters', request).descriptors
        assert values_of(b) == Config().flat()
    for spec, descriptor in zip(specs, descriptors, strict=True):
        assert descriptor.name == spec.name
        assert descriptor.type == TYPES[type(spec.default)]
        assert not descriptor.read_only
        assert descriptor.dynamic_typing == spec.auto
        assert spec.description in descriptor.description
        assert spec.unit in descriptor.description
        assert spec.symbol in descriptor.description
        assert spec.accepted in descriptor.additional_constraints
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert len(ranges) == (spec.type in (int, float))
        for accepted in ranges:
            assert (accepted.from_value, accepted.to_value) == (spec.minimum, spec.maximum)
            assert accepted.step == 0


def test_a_change_takes_effect_with_the_next_cloud():
    points = street(5000)
    message = to_message(points)
    with bench() as b:
        assert b.segment(message)[0].width == n_ground(points)
        for name, value in (
            ('label.ground_tolerance', 0.01),
            ('grid.n_segments', 8),
            ('runtime.n_threads', 1),
            ('runtime.backend', 'numpy'),
        ):
            before = b.node.config
            assert b.set(name, value).successful
            assert b.node.config == before.replace(**{name: value})
            expected = n_ground(points, **b.node.config.flat())
            assert b.segment(message)[0].width == expected
        assert n_ground(points) != n_ground(points, **{'label.ground_tolerance': 0.01})


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('sensor.height', 30.0, 'sensor.height = 30.0: must be auto or a number in [0.05, 20] m'),
        (
            'sensor.height',
            float('nan'),
            'sensor.height = nan: must be auto or a number in [0.05, 20] m',
        ),
        (
            'sensor.height',
            2,
            'sensor.height = 2: must be auto or a number in [0.05, 20] m, with a decimal ',
        ),
        ('sensor.height', '2', "sensor.height = '2': must be auto or a number in [0.05, 20] m"),
        ('sensor.height', True, 'sensor.height = True: must be auto or a number in [0.05, 20] m'),
        ('sensor.height', [1.0], 'sensor.height = '),
        ('sensor.height', None, 'sensor.height = None: must be auto or a number in [0.05, 20] m'),
        ('grid.n_segments', 3, 'grid.n_segments = 3: must be an integer in [4, 2048]'),
        ('grid.n_segments', 90.0, 'grid.n_segments = 90.0: must be an integer in [4, 2048]'),
        ('runtime.backend', 'gpu', "runtime.backend = 'gpu': must be one of auto, numba, numpy"),
        ('grid.r_max', 1.5, 'grid.r_min = 2: must be below grid.r_max = 1.5'),
        ('lable.ground_tolerance', 0.1, 'did you mean label.ground_tolerance?'),
    ],
)
def test_a_bad_value_is_refused_with_a_reason_and_changes_nothing(
    shared_bench, name, value, reason
):
    b = shared_bench
    before = values_of(b)
    result = b.set(name, value)
    assert not result.successful
    assert reason in result.reason
    assert values_of(b) == before == b.node.config.flat()


@pytest.fixture(scope='module')
def shared_bench():
    with bench() as b:
        yield b


def test_several_at_once_are_all_taken_or_none(shared_bench):
    b = shared_bench
    before = values_of(b)

    def set_all(**values):
        messages = [parameter_message(f'grid.{name}', value) for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=messages)
        return b.call(SetParametersAtomically, 'set_parameters_atomically', request).result

    refused = set_all(n_segments=90, r_min=40.0, r_max=30.0)
    assert not refused.successful
    assert 'grid.r_min = 40: must be below grid.r_max = 30' in refused.reason
    assert values_of(b) == before
    # Neither of these could come alone after the other way round.
    assert set_all(r_min=40.0, r_max=49.0).successful
    assert set_all(r_max=30.0, r_min=1.0).successful
    assert values_of(b) == {**before, 'grid.r_min': 1.0, 'grid.r_max': 30.0}
    assert set_all(r_max=before['grid.r_max'], r_min=before['grid.r_min']).successful


def test_parameters_of_ros_itself_pass_through(shared_bench):
    b = shared_bench
    assert b.set('use_sim_time', True).successful
    assert b.set('use_sim_time', False).successful


def test_a_fault_in_the_check_is_answered_and_the_node_lives(shared_bench, monkeypatch):
    b = shared_bench
    with monkeypatch.context() as patch:
        patch.setattr(b.node, 'check_config', lambda _config: 1 / 0)
        result = b.set('sensor.height', 1.0)
        assert not result.successful
        assert 'ZeroDivisionError' in result.reason
    assert b.set('sensor.height', 1.73).successful
    assert b.set('sensor.height', 'auto').successful


@pytest.mark.parametrize('name', ['sensor.height', 'sensor.roll', 'sensor.pitch'])
def test_a_number_or_auto_is_taken_and_nothing_else(shared_bench, name):
    b = shared_bench
    for value in (0.5, 'auto', 0.7, 0.6, 'auto'):
        assert b.set(name, value).successful
        assert values_of(b)[name] == value == b.node.config[name]
        request = DescribeParameters.Request(names=[name])
        (found,) = b.call(DescribeParameters, 'describe_parameters', request).descriptors
        assert found.type == TYPES[type(value)]
        assert found.floating_point_range[0].to_value == find_spec(name).maximum
    for value in ('Auto', 'automatic', '', '0.5', 1, True, 99.0, -99.0, float('inf'), [0.5], None):
        result = b.set(name, value)
        assert not result.successful
        assert f'{name} = ' in result.reason
        assert 'must be auto or a number in [' in result.reason
        assert values_of(b)[name] == 'auto'


def test_auto_survives_dump_and_load(shared_bench, tmp_path):
    """`ros2 param dump` writes what `get` returns; `load` sets it again, value by value."""
    b = shared_bench
    for height in (1.2, 'auto'):
        assert b.set('sensor.height', height).successful
        path = tmp_path / 'dump.yaml'
        path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values_of(b)}}))
        assert Config.from_yaml(path) == b.node.config
        for name, value in yaml.safe_load(path.read_text())['/**']['ros__parameters'].items():
            assert b.set(name, value).successful, name
        assert b.node.config == Config().replace(**{'sensor.height': height})


def test_local_calls_are_checked_too(shared_bench):
    b = shared_bench
    (result,) = b.in_executor(
        b.node.set_parameters, [Parameter('label.ground_tolerance', value=9.0)]
    )
    assert not result.successful
    assert b.node.config == Config()


def test_diagnostics_period_changes_live(shared_bench):
    b = shared_bench
    assert b.set('diagnostics.period', 60.0).successful
    assert b.set('diagnostics.period', 0.1).successful
    count = len(b.diagnostics.messages)
    b.diagnostics.wait(count + 3)
    assert b.set('diagnostics.period', 1.0).successful


def test_hundred_changes_during_playback_lose_no_frame(shared_bench):
    b = shared_bench
    message = to_message(street(2000))
    tolerances = np.linspace(0.05, 0.5, 100)
    before = len(b.ground.messages)
    assert b.set('learning.mode', 'fixed').successful
    for k, tolerance in enumerate(tolerances):
        b.publisher.publish(message)
        is_bad = k % 10 == 9
        result = b.set('label.ground_tolerance', 9.0 if is_bad else float(tolerance))
        assert result.successful != is_bad
    b.ground.wait(before + 100)
    b.obstacles.wait(before + 100)
    assert b.node.config.label.ground_tolerance == tolerances[98]
    for name in ('learning.mode', 'label.ground_tolerance'):
        assert b.set(name, Config()[name]).successful


def test_unknown_names_are_reported_and_not_declared(capfd):
    words = [
        '--ros-args',
        *('-p', 'lable.ground_tolerance:=0.3'),
        *('-p', 'qos_overrides./nowhere.subscription.depth:=3'),
        *('-p', 'sensor.height:=2.5'),
    ]
    with isolated_context() as context:
        node = GroundSegmentationNode(context=context, cli_args=words)
        with spinning(context, node):
            assert node.config == Config().replace(**{'sensor.height': 2.5})
            assert node.get_parameter('sensor.height').value == 2.5
            assert not node.has_parameter('lable.ground_tolerance')
            log = ''

            def said_both():
                nonlocal log
                log += capfd.readouterr().err
                return 'did you mean label.ground_tolerance?' in log and '/nowhere' in log

            wait_for(said_both, 'warnings')
    assert log.count('is not used') == 2
    assert '  sensor.height: 2.5 m  (default auto)' in log
    assert '  sensor.roll: auto\n' in log


def test_constructor_raises_config_error():
    with isolated_context() as context, pytest.raises(ConfigError, match=r'sensor\.height = 99'):
        GroundSegmentationNode(
            context=context, cli_args=['--ros-args', '-p', 'sensor.height:=99.0']
        )
