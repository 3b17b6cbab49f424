"""Ground segmentation of one LiDAR scan: the paper's Algorithm 2."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy.typing as npt

from gp_ground_seg.backend import Backend, make_backend
from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.frame import Candidates, FloatArray, GroundSurface, PointArray
from gp_ground_seg.gp.blas import single_threaded_blas
from gp_ground_seg.gp.frame_model import FrameModel
from gp_ground_seg.gp.learning import Learned
from gp_ground_seg.parameters.config import Config, SensorConfig
from gp_ground_seg.pipeline.labelling import LabelTask
from gp_ground_seg.pipeline.points import take_points
from gp_ground_seg.pipeline.sensor_pose import SensorPose, estimate_pose, given_pose
from gp_ground_seg.pipeline.sorted_points import SortedPoints
from gp_ground_seg.pipeline.tilt import turned_sample
from gp_ground_seg.result import Fitting, Segmentation
from gp_ground_seg.timing import StageTimer


@dataclass(frozen=True)
class _PlacedScan:
    """Points (N, 3) in the sensor frame, and in the level frame that the pose leads to."""

    own_xyz: PointArray
    level: SortedPoints
    pose: SensorPose


class GroundSegmenter:
    """Splits scans into ground and obstacles.

    Parameters
    ----------
    config : Config
        Parameters; `configure` changes them between scans.
    clock : callable
        Source of the seconds in ``Segmentation.timings`` and of ``learning.max_time``.
    backend : Backend, optional
        Who computes, until the parameters ``runtime`` change; by default as they say.

    Raises
    ------
    MissingDependencyError
        If ``runtime.backend`` is numba and numba is not installed.
    """

    def __init__(
        self,
        config: Config | None = None,
        clock: Callable[[], float] = time.perf_counter,
        backend: Backend | None = None,
    ) -> None:
        self._clock = clock
        self._config = config if config is not None else Config()
        self._backend = make_backend(self._config.runtime) if backend is None else backend
        self._workspace = Workspace()
        self._theta: FloatArray | None = None
        self._frames_since_learning = 0

    @property
    def config(self) -> Config:
        """Parameters of the next scan."""
        return self._config

    @property
    def backend_name(self) -> str:
        """Who computes: ``numba`` or ``numpy``."""
        return self._backend.name

    def configure(self, config: Config) -> None:
        """Use `config` from the next scan on; what was learned under another is forgotten."""
        if config.runtime != self._config.runtime:
            self._backend.close()
            self._backend = make_backend(config.runtime)
        if dataclasses.replace(config, diagnostics=self._config.diagnostics) != self._config:
            self.reset()
        self._config = config

    def use_backend(self, backend: Backend) -> None:
        """Segment with `backend` from the next scan on (stub of the lead's method)."""
        self._backend.close()
        self._backend = backend

    def reset(self) -> None:
        """Forget what earlier scans taught, as after a jump in time."""
        self._theta = None

    def close(self) -> None:
        """End the worker threads; the segmenter is of no use afterwards."""
        self._backend.close()

    def segment(
        self, points: npt.ArrayLike, tilt: tuple[float, float] | None = None
    ) -> Segmentation:
        """Label every point of a scan.

        Parameters
        ----------
        points : (N, >=3) float array
            x forward, y left, z up in the sensor frame [m]; never written to.
        tilt : tuple of float, optional
            Roll and pitch of the sensor in this scan [rad], instead of ``sensor.roll``
            and ``sensor.pitch``.

        Raises
        ------
        PointCloudError
            If the array has another shape or type, or z clearly does not point up.
        """
        config = self._config
        sensor = config.sensor
        if tilt is not None:
            sensor = dataclasses.replace(sensor, roll=tilt[0], pitch=tilt[1])
        timer = StageTimer(self._clock)
        placed = self._place(points, sensor, timer)
        scan, pose = placed.level, placed.pose
        grid = scan.grid

        faces = scan.find_faces()
        timer.mark('faces')

        candidates, lines, pseudo, follows = self._backend.find_lines(
            scan.candidates, faces.is_footless, config
        )
        timer.mark('lines')

        # Of mean zero, the process would be pulled to the height of the sensor.
        expected_ground = -pose.height
        model = FrameModel(
            config, self._backend, candidates, expected_ground, lines, pseudo, follows, grid.edges
        )
        theta, learned = self._learn(model)
        timer.mark('learning')

        to_label = LabelTask(scan.xyz, grid, faces, config.label, config.faces.tolerance)
        inlier, mean, std, log_length_scale = model.surface(theta, to_label)
        surface = GroundSurface(grid.edges, mean, std, inlier)
        timer.mark('surface')

        labelled = self._backend.label_points(to_label, surface)
        tilted_ground_z = (
            None if pose.is_level else pose.ground_z(placed.own_xyz[:, 2], labelled.height)
        )
        timer.mark('label')

        backend = self._backend
        return Segmentation(
            labelled,
            timer.seconds,
            Fitting(config.learning.mode, learned, backend.name, backend.n_threads),
            grid,
            candidates,
            lines,
            pseudo,
            surface,
            theta,
            log_length_scale,
            pose,
            tilted_ground_z,
        )

    def estimate_pose(self, points: npt.ArrayLike) -> SensorPose:
        """Find out height and tilt of the sensor as `segment` does, and no more.

        Parameters and errors are those of `segment`.
        """
        timer = StageTimer(self._clock)
        placed = self._place(points, self._config.sensor, timer)
        placed.level.drop_faces()
        return placed.pose

    def _place(
        self, points: npt.ArrayLike, sensor: SensorConfig, timer: StageTimer
    ) -> _PlacedScan:
        """Scan in the level frame, as given or as it seems to be."""
        own_xyz = take_points(points)
        given = given_pose(sensor)
        scan = self._sort(given.level(own_xyz))
        try:
            timer.mark('grid')
            pose = estimate_pose(
                scan.candidates,
                sensor,
                self._backend.name == 'numba',
                lambda turn: self._turned_candidates(scan.xyz, turn),
            )
        except BaseException:
            scan.drop_faces()
            raise
        if (pose.roll, pose.pitch) != (given.roll, given.pitch):
            scan.drop_faces()
            scan = self._sort(pose.level(own_xyz))
        timer.mark('pose')
        return _PlacedScan(own_xyz, scan, pose)

    def _sort(self, xyz: PointArray) -> SortedPoints:
        return self._backend.sort_points(xyz, self._config, self._workspace)

    def _turned_candidates(self, xyz: PointArray, turn: FloatArray) -> Candidates:
        """Candidates of a sample of the points turned by a matrix (3, 3)."""
        sample = turned_sample(xyz, turn)
        return self._backend.sort_points(sample, self._config, Workspace(), False).candidates

    def _learn(self, model: FrameModel) -> tuple[FloatArray, list[Learned]]:
        """Theta of this frame by ``learning.mode``; (M, 5 + K) and the outcome, if learned."""
        learning = self._config.learning
        given = model.given_theta()
        if learning.mode == 'fixed':
            return given, []
        keeps = {'every_frame': 1, 'every_k': learning.period, 'first_frame': None}[learning.mode]
        self._frames_since_learning += 1
        if self._theta is not None and (keeps is None or self._frames_since_learning < keeps):
            return self._theta, []
        started = self._clock() if learning.max_time > 0.0 else 0.0

        def out_of_time() -> bool:
            return 0.0 < learning.max_time <= self._clock() - started

        start = self._theta if self._theta is not None and learning.warm_start else given
        with single_threaded_blas():
            self._theta, learned = model.learn(start, out_of_time)
        self._frames_since_learning = 0
        return self._theta, learned
