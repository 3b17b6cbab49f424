"""What a measurement ran on: machine, versions, commit, parameters."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from dataclasses import dataclass
from pathlib import Path

import gp_ground_seg
from gp_ground_seg.parameters.config import Config, parameter_specs
from gp_ground_seg.parameters.schema import ParameterValue


@dataclass(frozen=True)
class Environment:
    """Machine and software of a run.

    Attributes
    ----------
    cpu, n_cores : str, int
        Name of the processor, and the cores this process may use.
    python, versions : str, dict of str to str or None
        Versions of Python, of this package and of those it computes with; None = not installed.
    commit : str or None
        Commit of the source, with ``-dirty`` if changed since; None outside git.
    """

    cpu: str
    n_cores: int
    python: str
    versions: dict[str, str | None]
    commit: str | None

    def machine(self, n_threads: int, backend: str) -> str:
        """One line on where a measurement ran."""
        threads = '1 thread' if n_threads == 1 else f'{n_threads} threads'
        cores = '1 core' if self.n_cores == 1 else f'{self.n_cores} cores'
        versions = ', '.join(f'{name} {v or "absent"}' for name, v in self.versions.items())
        commit, _, dirty = (self.commit or 'unknown').partition('-')
        commit = commit[:12] + (' (changed since)' if dirty else '')
        return (
            f'machine: {self.cpu}, {threads} on {cores}, {backend}; Python {self.python}, '
            f'{versions}, commit {commit}'
        )


def describe_environment(*packages: str) -> Environment:
    """Describe this machine; `packages` are further ones whose version matters."""
    versions: dict[str, str | None] = {'gp_ground_seg': gp_ground_seg.__version__}
    for package in ('numpy', 'scipy', 'numba', *packages):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return Environment(
        cpu=_cpu_name(),
        n_cores=len(os.sched_getaffinity(0)),
        python=platform.python_version(),
        versions=versions,
        commit=_commit(Path(gp_ground_seg.__file__)),
    )


def changed_parameters(config: Config) -> dict[str, ParameterValue]:
    """Parameters that differ from their defaults, by dotted name."""
    return {
        spec.name: value
        for spec in parameter_specs()
        if (value := config[spec.name]) != spec.default
    }


def parameters_line(changes: dict[str, ParameterValue]) -> str:
    """One line on the parameters of a run."""
    words = ', '.join(f'{name}={value}' for name, value in changes.items())
    return f'parameters: {words or "defaults"}'


def _cpu_name() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    except OSError:
        lines = []
    names = (line.partition(':')[2].strip() for line in lines if line.startswith('model name'))
    return next(names, platform.processor() or platform.machine())


def _commit(source: Path) -> str | None:
    """Commit that holds the file `source`, None if git does not know the file.

    An installed package may lie inside another repository, whose commit says nothing of it.
    """
    if _git(source.parent, 'ls-files', '--error-unmatch', source.name) is None:
        return None
    return _git(source.parent, 'describe', '--always', '--abbrev=40', '--dirty', '--exclude=*')


def _git(folder: Path, *words: str) -> str | None:
    try:
        run = subprocess.run(
            ['git', *words], cwd=folder, capture_output=True, text=True, timeout=10.0
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return run.stdout.strip() if run.returncode == 0 else None
