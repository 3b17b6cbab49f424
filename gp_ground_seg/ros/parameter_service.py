"""The parameter services of a node, where rules hold between parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService

Setter = Callable[[list[Parameter]], SetParametersResult]


def set_in_any_order(
    parameters: Sequence[Parameter], set_atomically: Setter
) -> list[SetParametersResult]:
    """Set as many parameters as can be set, whatever order they come in.

    ``ros2 param load`` sends a whole file at once, and rclpy sets its values one after
    the other: one that breaks a rule with a value that is still to come would be refused.
    Here all are tried together; where that fails, one by one, those refused once more
    after every round that set any.

    Returns
    -------
    list of SetParametersResult
        One for each parameter, in order.
    """
    together = set_atomically(list(parameters))
    if together.successful:
        return [together] * len(parameters)
    results: dict[int, SetParametersResult] = {}
    pending = list(range(len(parameters)))
    while pending:
        for k in pending:
            results[k] = set_atomically([parameters[k]])
        refused = [k for k in pending if not results[k].successful]
        if len(refused) == len(pending):
            break
        pending = refused
    return [results[k] for k in range(len(parameters))]


class OrderFreeParameterService(ParameterService):  # type: ignore[misc]
    """rclpy's parameter services, of which ``set_parameters`` does not mind the order.

    Should rclpy call its method by another name one day, its own order is back.

    Parameters
    ----------
    node : Node
        Node of the parameters, made with ``start_parameter_services=False``.
    """

    def __init__(self, node: Node) -> None:
        self._set_atomically: Setter = node.set_parameters_atomically
        super().__init__(node)

    def _set_parameters_callback(self, request: Any, response: Any) -> Any:
        parameters = [Parameter.from_parameter_msg(message) for message in request.parameters]
        response.results = set_in_any_order(parameters, self._set_atomically)
        return response
