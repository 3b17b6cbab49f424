"""A first frame that costs nobody anything."""

from __future__ import annotations

import gc
import math
import os
import pickle
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from threading import Thread

import numpy as np

from gp_ground_seg.backend import Backend
from gp_ground_seg.frame import PointArray
from gp_ground_seg.gp.numpy_backend import NumpyBackend
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.sensor_pose import given_pose
from gp_ground_seg.segmenter import GroundSegmenter

_RINGS = 24
_DIRECTIONS = 64
_PARTS = {
    'points': ('sort_points', 'find_lines'),
    'processes': ('grow', 'grow_on_latent', 'objective', 'label_points'),
}
"""Methods of the backend whose code is compiled side by side."""
_LOOK_AROUND = 0.2
"""Seconds after which the compiling process looks whether it is still asked for."""


def warm_up(segmenter: GroundSegmenter) -> float:
    """Segment a small made-up frame, so that all code is there before a cloud waits for it.

    Code that is not kept on disk is compiled by other processes, whose memory goes when
    they end: the compiler leaves twice as much behind as the node needs. What was learned
    from the frame is forgotten.

    Returns
    -------
    float
        Time it took [s].
    """
    start = time.monotonic()
    points = _flat_ground(segmenter.config)
    if segmenter.backend_name == 'numba':
        _compile_elsewhere(segmenter, points)
    segmenter.segment(points)
    segmenter.reset()
    return time.monotonic() - start


def _compile_elsewhere(segmenter: GroundSegmenter, points: PointArray) -> None:
    """Have other processes put on disk what is not there, if they can."""
    from gp_ground_seg.compiled.compile_cache import (
        CodeNotKeptError,
        refusing,
        say_that_it_compiles,
    )

    try:
        with refusing('compilation'):
            segmenter.segment(points)
    except CodeNotKeptError:
        say_that_it_compiles()
        # What they do not manage is compiled here.
        _run_compilers(segmenter.config)


def _run_compilers(config: Config) -> None:
    program = f'import sys; from {__name__} import compile_part; compile_part(sys.argv[1])'
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(path for path in sys.path if path)}
    with ExitStack() as stack:
        compilers = []
        for part in _PARTS:
            words = [sys.executable, '-c', program, part]
            compiler = subprocess.Popen(
                words,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(compiler.wait)
            stack.callback(compiler.kill)
            compilers.append(compiler)
            assert compiler.stdin is not None
            with suppress(BrokenPipeError), compiler.stdin as stdin:
                stdin.write(pickle.dumps(config))
        for compiler in compilers:
            compiler.wait()


def _half_compiled(part: str) -> Backend:
    """Backend with the methods of a part in compiled code, the others in numpy."""
    from gp_ground_seg.compiled.backend import CompiledBackend

    # Two threads, for there is code for the other one.
    compiled, plain = CompiledBackend(2), NumpyBackend()
    # What else is compiled, about the candidates, goes by the name.
    half: Backend = CompiledBackend(1) if part == 'points' else NumpyBackend()
    for other, methods in _PARTS.items():
        for method in methods:
            setattr(half, method, getattr(compiled if other == part else plain, method))
    return half


def compile_part(part: str) -> None:
    """Compile the code of a part for a configuration, which comes pickled by standard input.

    Ends when the process that asked for it has ended, and where nothing can be kept.
    """
    from gp_ground_seg.compiled.compile_cache import CodeNotKeptError, refusing

    # The compiler makes objects by the million that stay: looked through less often.
    gc.set_threshold(20_000, 20, 50)
    asked_by = os.getppid()
    config: Config = pickle.load(sys.stdin.buffer)
    Thread(target=_end_without, args=(asked_by,), daemon=True).start()
    segmenter = GroundSegmenter(config, backend=_half_compiled(part))
    with suppress(CodeNotKeptError), refusing('loss'):
        segmenter.segment(_flat_ground(config))


def _end_without(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK_AROUND)
    os._exit(1)


def _flat_ground(config: Config) -> PointArray:
    """Rings on level ground as the sensor would see them, (N, 3) float32 [m]."""
    nearest = config.grid.r_min
    radius, azimuth = np.meshgrid(
        np.linspace(nearest, min(nearest + 30.0, config.grid.r_max), _RINGS),
        np.linspace(-math.pi, math.pi, _DIRECTIONS, endpoint=False),
    )
    pose = given_pose(config.sensor)
    height = np.full(radius.shape, -pose.height)
    level = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)
    turned: PointArray = (level.reshape(-1, 3) @ pose.rotation).astype(np.float32)
    return turned
