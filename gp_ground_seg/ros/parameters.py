"""The parameters of `gp_ground_seg.core.parameters.config` as ROS parameters of a node."""

from array import array
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult as Result
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService

from gp_ground_seg.core.errors import ConfigError, GroundSegError
from gp_ground_seg.core.parameters.config import Config, parameter_specs
from gp_ground_seg.core.parameters.schema import EMPTY_LIST, OF_EVERY_NODE, ParameterSpec
from gp_ground_seg.ros.arguments import start_errors
from gp_ground_seg.ros.input import QOS_OVERRIDES, check_overrides

_NAMES = frozenset(spec.name for spec in parameter_specs())


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return what ``ros2 param describe`` and rqt_reconfigure show of a parameter."""
    notes = [f'[{spec.unit}]'] if spec.unit else []
    notes += [f'({spec.symbol} in the paper)'] if spec.symbol else []
    notes += [] if spec.basic else ['(advanced)']
    result = ParameterDescriptor(
        description=' '.join([spec.description, *notes]),
        additional_constraints=f'must be {spec.accepted}',
        # ROS has no type for a number or a word, or a list or a word; `changed` checks the value.
        dynamic_typing=spec.auto or spec.type is tuple,
    )
    # No step: rclpy would refuse every value off the grid.
    low, high = spec.minimum, spec.maximum
    if spec.type is float:
        result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif spec.type is int:
        result.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return result


def changed(config: Config, parameters: Iterable[Parameter]) -> Config:
    """Return `config` with those of the `parameters` that it declares, if they are accepted."""
    # Of a list ROS makes an array, which an error would show as such.
    values = {
        given.name: list(given.value) if isinstance(given.value, array) else given.value
        for given in parameters
        if given.name in _NAMES
    }
    return config.replace(**values)


def describe(config: Config, node_name: str) -> str:
    """Return one line per parameter that is not at its default, and how to see all."""
    lines = []
    for spec, default, value in Config().differences(config):
        unit = f' {spec.unit}' if spec.unit and not isinstance(value, str) else ''
        lines.append(f'\n  {spec.name}: {value}{unit}  (default {default})')
    head = 'parameters that differ from the defaults' if lines else 'parameters: all defaults'
    how = f'all values by ros2 param dump {node_name}, explained by gp-ground-seg config dump'
    return f'{head} ({how}){":" if lines else ""}{"".join(lines)}'


class ConfiguredNode(Node):  # type: ignore[misc]
    """A node, with the options of `rclpy.node.Node`, whose ROS parameters are a `Config`.

    Values set at run time are checked as a whole before anything changes. Raises a ConfigError
    if a parameter file or ``-p`` gives a value that is not accepted.
    """

    config: Config  # parameters in use

    def __init__(self, name: str, **options: Any) -> None:
        with start_errors():
            super().__init__(name, start_parameter_services=False, **options)
        # What a file or ``-p`` gives (not public): of an empty list or group it has the name.
        every = self._parameter_overrides.items()
        self._given = {name: given for name, given in every if name not in OF_EVERY_NODE}
        values = {name: given.value for name, given in self._given.items()}
        for name, value in values.items():
            if value is None and not any(known.startswith(f'{name}.') for known in _NAMES):
                raise ConfigError(f'{name} = []: {EMPTY_LIST}')
        check_overrides(values)
        self.config = changed(Config(), self._given.values())
        self.check_config(self.config)
        with start_errors():
            for spec in parameter_specs():
                value = self.config[spec.name]
                self.declare_parameter(spec.name, value, descriptor(spec), ignore_override=True)
        self.add_pre_set_parameters_callback(lambda parameters: list(map(_typed, parameters)))
        self.add_on_set_parameters_callback(self._on_set)
        self.add_post_set_parameters_callback(self._post_set)
        self._parameter_service = ParameterService(self)
        # Of rclpy's own, a value of unknown type ends the executor, and one sets one by one.
        ours = {SetParameters: self._on_request, SetParametersAtomically: self._on_atomic_request}
        for service in self.services:
            service.callback = ours.get(service.srv_type, service.callback)

    def check_config(self, config: Config) -> None:
        """Raise a GroundSegError if `config` cannot be used here; change nothing."""

    def apply_config(self, config: Config) -> None:
        """Use `config`, which `check_config` has accepted, from now on."""

    def warn_of_unused_parameters(self) -> None:
        """Log what was given and is not declared; call it after all topics are made."""
        for name in sorted(self._given):
            if not self.has_parameter(name):
                is_qos = name.startswith(QOS_OVERRIDES)
                reason = 'no such topic or policy here' if is_qos else _unknown(name)
                self.get_logger().warning(f'parameter {name} is not used: {reason}')

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Result:
        """Set all or none; checked before rclpy does, whose reasons do not contain the name."""
        for parameter in parameter_list:
            if parameter.name not in _NAMES and not self.has_parameter(parameter.name):
                return Result(successful=False, reason=_unknown(parameter.name))
        result = self._on_set(parameter_list)
        return super().set_parameters_atomically(parameter_list) if result.successful else result

    def _on_request(self, request: Any, response: Any) -> Any:
        """Set all at once, or one by one if that is refused.

        ``ros2 param load`` sends a whole file: one by one, a value that contradicts another
        still to come would be refused.
        """
        messages = request.parameters
        result = self._set_all(messages)
        is_set = result.successful
        response.results = [result if is_set else self._set_all([one]) for one in messages]
        return response

    def _on_atomic_request(self, request: Any, response: Any) -> Any:
        response.result = self._set_all(request.parameters)
        return response

    def _set_all(self, messages: Iterable[ParameterMessage]) -> Result:
        try:
            parameters = [Parameter.from_parameter_msg(message) for message in messages]
            return self.set_parameters_atomically(parameters)
        except Exception as error:  # the caller would get no answer
            reason = f'{type(error).__name__}: {error}'
            self.get_logger().error(f'parameters could not be set: {reason}')
            return Result(successful=False, reason=reason)

    def _on_set(self, parameters: list[Parameter]) -> Result:
        try:
            self.check_config(changed(self.config, parameters))
        except GroundSegError as error:
            return Result(successful=False, reason=str(error))
        return Result(successful=True)

    def _post_set(self, parameters: list[Parameter]) -> None:
        config = changed(self.config, parameters)
        if config != self.config:
            self.apply_config(config)
            before, self.config = self.config, config
            for spec, old, new in before.differences(config):
                self.get_logger().info(f'{spec.name}: {old} -> {new}')


def _typed(parameter: Parameter) -> Parameter:
    """Return an integer given for a number as a number: YAML and ``ros2 param set`` read 2 so."""
    is_number = parameter.name in _NAMES and Config.find_spec(parameter.name).type is float
    if is_number and parameter.type_ == Parameter.Type.INTEGER:
        return Parameter(parameter.name, value=float(parameter.value))
    return parameter


def _unknown(name: str) -> str:
    try:
        Config.find_spec(name)
    except ConfigError as error:
        return str(error)
    return f'{name} is not declared'
