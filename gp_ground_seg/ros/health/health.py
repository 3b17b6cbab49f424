"""All that the node says of itself."""

from __future__ import annotations

from collections.abc import Mapping

from gp_ground_seg.parameters.config import DiagnosticsConfig
from gp_ground_seg.ros.health.hysteresis import Hysteresis
from gp_ground_seg.ros.health.input import InputFacts, InputStatistics
from gp_ground_seg.ros.health.model import ModelStatistics
from gp_ground_seg.ros.health.output import OutputStatistics
from gp_ground_seg.ros.health.processing import ProcessingStatistics
from gp_ground_seg.ros.health.status import Status


class Health:
    """The statistics of every task, judged with hysteresis.

    Parameters
    ----------
    now : float
        Time on a steady clock [s], as in the methods.

    Attributes
    ----------
    input, processing, model, output
        Where to count what happens.
    """

    def __init__(self, now: float) -> None:
        self.input = InputStatistics(now)
        self.processing = ProcessingStatistics()
        self.model = ModelStatistics()
        self.output = OutputStatistics()
        self._hysteresis: dict[str, Hysteresis] = {}

    def report(
        self,
        now: float,
        facts: InputFacts,
        n_subscribers: Mapping[str, int],
        limits: DiagnosticsConfig,
    ) -> list[Status]:
        """Return the status of each task.

        Parameters
        ----------
        now : float
            Time on a steady clock [s].
        facts : InputFacts
            The input at this moment.
        n_subscribers : mapping
            Subscribers of each output topic.
        limits : DiagnosticsConfig
            When to complain, and for how long.
        """
        found = (
            self.input.report(now, facts, limits),
            self.processing.report(now, limits),
            self.model.report(limits),
            self.output.report(now, n_subscribers),
        )
        return [
            self._hysteresis.setdefault(status.task, Hysteresis()).hold(
                now, status, limits.recover_after
            )
            for status in found
        ]
