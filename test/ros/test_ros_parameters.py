"""Parameters of the node through its ROS services, and at its start."""

import math

import numpy as np
import pytest
import ros_helpers as ros
import yaml
from config_samples import configs
from hypothesis import given, settings
from hypothesis import strategies as st
from rcl_interfaces import srv
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter, parameter_value_to_python
from ros_helpers import bench, street, to_message

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.jit import HAVE_NUMBA
from gp_ground_seg.core.parameters.config import parameter_specs
from gp_ground_seg.core.parameters.schema import flatten
from gp_ground_seg.ros.loader import CHANGED

pytestmark = pytest.mark.usefixtures('compiled_code')

TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}
SPECS = parameter_specs()
NAMES = [spec.name for spec in SPECS]
DEFAULTS = {name: Config()[name] for name in ros.PATIENT}


@pytest.fixture(scope='module')
def shared():
    with bench(DEFAULTS) as b:
        assert values_of(b) == flatten(Config().nested())
        yield b


@pytest.fixture
def b(shared):
    """The shared node, whatever the test before has left, with the defaults."""
    assert_loaded(shared, Config())
    return shared


def assert_loaded(b, config):
    """Load a configuration over any other."""
    assert all(result.successful for result in b.load(flatten(config.nested())))
    assert b.node.config == config


def values_of(b, names=NAMES):
    response = b.call(srv.GetParameters, 'get_parameters', srv.GetParameters.Request(names=names))
    values = [parameter_value_to_python(value) for value in response.values]
    return dict(zip(names, values, strict=True))


def described(b, names):
    request = srv.DescribeParameters.Request(names=names)
    return b.call(srv.DescribeParameters, 'describe_parameters', request).descriptors


def test_every_parameter_is_described_with_type_range_unit_and_symbol(b):
    for spec, descriptor in zip(SPECS, described(b, NAMES), strict=True):
        assert descriptor.name == spec.name
        assert descriptor.type == TYPES[type(spec.default)]
        assert not descriptor.read_only
        assert descriptor.dynamic_typing == (spec.auto or spec.type is tuple)
        assert spec.description in descriptor.description
        assert spec.unit in descriptor.description
        assert spec.symbol in descriptor.description
        assert spec.accepted in descriptor.additional_constraints
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert len(ranges) == (spec.type in (int, float))
        for accepted in ranges:
            assert (accepted.from_value, accepted.to_value) == (spec.minimum, spec.maximum)
            assert accepted.step == 0


def n_ground(points, config):
    label = GroundSegmenter(config).segment(ros.xyz_of(points)).label
    return int((label == Label.GROUND).sum())


def test_a_change_takes_effect_with_the_next_cloud(b, tmp_path):
    with ros.stderr_in(tmp_path) as said:
        points = street(5000)
        message = to_message(points)
        assert b.segment(message)[0].width == n_ground(points, Config())
        for name, value in (
            ('label.ground_tolerance', 0.01),
            ('grid.n_segments', 8),
            ('runtime.backend', 'numpy'),
        ):
            before = b.node.config
            assert not b.set(name, value)
            assert b.node.config == before.replace(**{name: value})
            said(f'{name}: {before[name]} -> {value}\n')
            assert b.segment(message)[0].width == n_ground(points, b.node.config)
        narrow = Config().replace(**{'label.ground_tolerance': 0.01})
        assert n_ground(points, Config()) != n_ground(points, narrow)


WRONG = {
    'sensor.height': [
        'sensor.height = 30.0: must be auto or a number in [-5, 20] m', 30.0, 'Auto', 'automatic',
        '', '0.5', True, 99, math.nan, math.inf, [0.5], None,
    ],
    'grid.n_segments': ['grid.n_segments = 3: must be an integer in [4, 2048]', 3, 90.0],
    'runtime.backend': ["runtime.backend = 'gpu': must be one of auto, numba, numpy", 'gpu'],
    'grid.r_max': ['grid.r_min = 2: must be below grid.r_max = 1.5', 1.5],
    'input.crop_box': [
        'input.crop_box = [1.0, -1.0, 0.0, 1.0, 0.0, 1.0]: must be none or six numbers in [',
        [1.0, -1.0, 0.0, 1.0, 0.0, 1.0],
    ],
    'lable.ground_tolerance': ['did you mean label.ground_tolerance?', 0.1],
}  # fmt: skip
"""For each name the reason of the first refusal, and values; the others have its end."""


@pytest.mark.parametrize('name', WRONG)
def test_a_bad_value_is_refused_with_a_reason_and_changes_nothing(b, name):
    reason, first, *others = WRONG[name]
    assert reason in b.set(name, first)
    for value in others:
        said = b.set(name, value)
        assert said.startswith(f'{name} = ') and said.endswith(reason.split('must be')[1])
    assert values_of(b) == flatten(b.node.config.nested()) == flatten(Config().nested())


@pytest.mark.parametrize('name', ['sensor.height', 'sensor.roll', 'sensor.pitch'])
def test_a_number_or_auto_is_taken(b, name):
    for value in (0.5, 'auto', 0.7, 'auto'):
        assert not b.set(name, value)
        assert values_of(b, [name]) == {name: value} == {name: b.node.config[name]}
        (found,) = described(b, [name])
        assert found.type == TYPES[type(value)]
        assert found.floating_point_range[0].to_value == Config.find_spec(name).maximum


def test_several_at_once_are_all_taken_or_none(b):
    def set_all(**values):
        messages = ros.parameter_messages({f'grid.{name}': v for name, v in values.items()})
        return b.request(srv.SetParametersAtomically, messages)[0]

    refused = set_all(n_segments=90, r_min=40.0, r_max=30.0)
    assert not refused.successful
    assert 'grid.r_min = 40: must be below grid.r_max = 30' in refused.reason
    assert values_of(b) == flatten(Config().nested())
    # Neither of these could come alone after the other way round.
    assert set_all(r_min=40.0, r_max=49.0).successful
    assert set_all(r_max=30.0, r_min=1.0).successful
    assert values_of(b) == {**flatten(Config().nested()), 'grid.r_min': 1.0, 'grid.r_max': 30.0}
    # Of a file, the good ones: one by one, r_min comes after the r_max that it has to be below.
    asked = {'label.ground_tolerance': 9.0, 'grid.r_max': 50.0, 'grid.r_min': 40.0}
    results = b.load(asked)
    assert [result.successful for result in results] == [False, True, True]
    assert 'label.ground_tolerance = 9.0: must be' in results[0].reason
    assert b.node.config == Config().replace(**{'grid.r_min': 40.0, 'grid.r_max': 50.0})


@pytest.mark.parametrize('setter', ros.SETTERS)
def test_an_integer_is_taken_for_any_number_and_text_for_a_box(b, setter):
    """As ``ros2 param set`` and rqt_reconfigure send what is typed without a point."""
    whole = {spec.name: int(spec.default) for spec in SPECS if str(spec.default).endswith('.0')}
    assert len(whole) > 20
    for name, value in {**whole, 'label.ground_tolerance': 1, 'sensor.height': 2}.items():
        (result,) = b.request(setter, ros.parameter_messages({name: value}))
        assert result.successful, result.reason
        (found,) = values_of(b, [name]).values()
        assert (type(found), found) == (float, value)
        assert b.node.config[name] == value
    box = {'input.crop_box': '[-1, 1.0, -1.0, 1.0, -1.6, 0.6]'}
    assert b.request(setter, ros.parameter_messages(box))[0].successful
    assert b.node.config.input.crop_box == (-1.0, 1.0, -1.0, 1.0, -1.6, 0.6)


def test_a_fault_in_the_check_is_answered_and_the_node_lives(b, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(b.node, 'check_config', lambda _config: 1 / 0)
        assert 'ZeroDivisionError' in b.set('sensor.height', 1.0)
    assert not b.set('sensor.height', 1.73)


def test_the_period_of_diagnostics_changes_live(b):
    # Calls in the process of the node are checked too.
    wrong = [Parameter('diagnostics.period', value=0.0)]
    (result,) = b.in_executor(b.node.set_parameters, wrong)
    assert not result.successful
    assert b.node.config == Config()
    assert not b.set('diagnostics.period', 60.0)
    assert not b.set('diagnostics.period', 0.1)
    b.diagnostics.wait(len(b.diagnostics.messages) + 3)


# Whole files, as `ros2 param dump` and `load` write and send them


def dump(b):
    """The document that ``ros2 param dump`` writes: all parameters, sorted, nested."""
    request = srv.ListParameters.Request()
    names = sorted(b.call(srv.ListParameters, 'list_parameters', request).result.names)
    tree = {}
    for name, value in values_of(b, names).items():
        *groups, leaf = name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        branch[leaf] = value
    return {b.node_name: {'ros__parameters': tree}}


@settings(max_examples=15)
@given(config=configs(), order=st.permutations(NAMES))
def test_any_configuration_can_be_loaded_over_any_other_in_any_order(shared, config, order):
    # TF may not be installed.
    plain = {'frame.level': 'sensor', 'frame.sensor': 'none', 'runtime.backend': 'auto'}
    config = config.replace(**plain)
    values = {name: config[name] for name in order}
    assert all(result.successful for result in shared.load(values))
    assert shared.node.config == config


@pytest.mark.parametrize('height', [1.2, 'auto'])
def test_what_is_dumped_is_what_runs_and_can_be_given_at_start(b, tmp_path, height):
    config = Config().replace(**{'sensor.height': height, 'grid.n_segments': 120})
    assert_loaded(b, config)
    path = tmp_path / 'dumped.yaml'
    path.write_text(yaml.safe_dump(dump(b)))
    # Our own tools read it, use_sim_time, qos_overrides and all.
    assert Config.problems_of_file(path) == []
    words = *ros.IN_NAMESPACE[1:], '-r', f'__node:={ros.NODE_NAME}', '--params-file', str(path)
    with ros.started_node(*words) as node:
        assert not node._input._is_pinned  # it follows the publishers, as without a file
        assert Config.from_yaml(path) == node.config == config


def test_changes_during_playback_lose_no_frame(b):
    message = to_message(street(2000))
    before = len(b.ground.messages)
    tolerances = np.linspace(0.05, 0.5, 27)
    for k, tolerance in enumerate(tolerances):
        b.publisher.publish(message)
        assert not b.set('grid.n_segments', 90 if k % 2 else 180)
        is_bad = k % 10 == 9
        reason = b.set('label.ground_tolerance', 9.0 if is_bad else float(tolerance))
        assert bool(reason) == is_bad
    b.ground.wait(before + 27)
    b.obstacles.wait(before + 27)
    assert b.node.config.label.ground_tolerance == tolerances[-1]


def test_unknown_names_are_reported_and_not_declared(tmp_path):
    words = {
        'lable.ground_tolerance': 0.3,
        'qos_overrides./nowhere.subscription.depth': 3,
        'sensor.height': 2.5,
        'grid.r_max': 50,
        'label.ground_tolerance': 1,
    }
    with ros.stderr_in(tmp_path) as said, ros.started_node(*ros.given(words)) as node:
        changes = {'sensor.height': 2.5, 'grid.r_max': 50.0, 'label.ground_tolerance': 1.0}
        changes |= ros.PATIENT
        assert node.config == Config().replace(**changes)
        for name, value in changes.items():
            assert node.get_parameter(name).type_ == Parameter.Type.DOUBLE
            assert node.get_parameter(name).value == value
        assert not node.has_parameter('lable.ground_tolerance')
        log = said('did you mean label.ground_tolerance?', '/nowhere')
    assert log.count('is not used') == 2
    shown = [line for line in log.splitlines() if '  (default ' in line]
    assert '  sensor.height: 2.5 m  (default auto)' in shown
    assert len(shown) == len(changes)  # a line for each that differs, and no other
    assert 'ros2 param dump /ground_segmentation_node' in log


@pytest.mark.parametrize('height', ['auto', 4.5])
def test_a_start_says_little_and_doubts_no_given_height_before_the_first_cloud(tmp_path, height):
    words = ros.given({'sensor.height': height, **DEFAULTS})
    with ros.stderr_in(tmp_path) as said, ros.started_node(*words):
        log = said('listening to', *[CHANGED] * HAVE_NUMBA)
    assert ('parameters: all defaults (all values by ros2 param dump' in log) == (height == 'auto')
    assert ('  sensor.height: 4.5 m  (default auto)\n' in log) == (height == 4.5)
    assert log.count('(default') == (height == 4.5) and len(log.splitlines()) <= 5
