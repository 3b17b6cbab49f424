"""``compare``: two configurations on the same frames."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack, closing, nullcontext
from pathlib import Path
from typing import Any

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, frames_from_options
from gp_ground_seg.core.errors import ConfigError, DataError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data.atomic_output import staged_files
from gp_ground_seg.data.inputs import list_inputs
from gp_ground_seg.lab.plotting.scan import plot_two_labels
from gp_ground_seg.lab.scale.cluster import Runner
from gp_ground_seg.lab.scoring import comparison, report
from gp_ground_seg.lab.scoring.evaluate import KnownScan, OurMethod, load_kitti, score_methods
from gp_ground_seg.lab.scoring.metrics import Labels
from gp_ground_seg.lab.scoring.report import Column, Table, percent

DESCRIPTION = """\
Run two configurations in turns on the same frames, and print their differences: IoU,
precision, recall, objects lost, error of the height and how often it is within one and two
standard deviations, time. Each difference has a bootstrap interval over the sequences, or over
blocks of frames of a single one. In a tie the interval holds 0. With -o the frames in which most
points have two labels are drawn.

A and B are parameter files or names of presets. For scans without labels, such as a folder
or a bag, the table has the points with two labels, and the time.
"""
EXAMPLES = """\
  gp-ground-seg compare default paper KITTI_ROOT
  gp-ground-seg compare default my.yaml KITTI_ROOT --sequences 00,08 -o pictures
  gp-ground-seg compare old.yaml new.yaml scans --json differences.json    scans/*.bin, no labels
"""
COLUMNS = (
    *(Column('sequence'), Column('frame'), Column('points', '_d')),
    percent('differ', 'share_different'),
    *(percent(f'ground in {name} only', f'share_{name}_only') for name in 'AB'),
)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'compare', DESCRIPTION, EXAMPLES)
    root = 'folder in SemanticKITTI layout; or a scan, a folder of scans, or a bag'
    options.add(
        parser,
        *((name, 'parameter file or preset', {'metavar': name.upper()}) for name in 'ab'),
        ('root', root, {'metavar': 'ROOT'}),
        *OF_FRAMES,
        ('--frames', 'list, and draw, so many frames that differ most (default: %(default)s)',
         {**options.NUMBER, 'default': 3}),
        ('-o --output', 'draw these frames into this folder (PNG)', {'metavar': 'FOLDER'}),
        options.MARKDOWN,
        options.TO_JSON,
        options.FORCE,
    )  # fmt: skip
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare, write the files, print the tables."""
    given = [arguments.a, arguments.b]
    configs = [options.named_config(name) for name in given]
    changed = options.changed_lines(*configs)
    if not changed:
        raise ConfigError(f'{" and ".join(given)}: the same parameters, nothing to compare')
    items, load = _items(arguments)
    target, n_drawn = arguments.output, min(arguments.frames, len(items))
    pictures = [f'differs_{k + 1}.png' for k in range(n_drawn)]
    rows: list[list[Any]] = []
    worst: list[tuple[list[Any], KnownScan, list[Labels]]] = []

    def watch(scan: KnownScan) -> None:
        one, other = labels = [method.last.label for method in methods]
        ground_a, ground_b = (label == Label.GROUND for label in labels)
        parts = one != other, ground_a & ~ground_b, ground_b & ~ground_a
        shares = [float(part.mean()) if len(part) else 0.0 for part in parts]
        rows.append([scan.sequence, scan.index, len(one), *shares])
        worst.append((rows[-1], scan, labels))
        worst.sort(key=lambda one: one[0][3], reverse=True)
        del worst[n_drawn:]

    staged = staged_files(target, pictures, force=arguments.force) if target else nullcontext()
    with (
        options.staged_options(arguments, 'json') as parts,
        staged as folder,
        ExitStack() as stack,
    ):
        methods = [
            stack.enter_context(closing(OurMethod(config, name)))
            for config, name in zip(configs, 'AB', strict=True)
        ]
        bar = options.progress('compare')
        scores = score_methods(items, load, methods, runner=Runner(bar), watch=watch)
        paths = [folder / name for name in pictures] if folder else []
        for path, (row, scan, labels) in zip(paths, worst, strict=False):
            truth = next(iter(scan.truths.values()), None)
            title = f'{row[0]}/{row[1]}: {row[3]:.2%} of the points have two labels'
            plot_two_labels(scan.points, labels, path, truth, title)
        differences = comparison.find_differences(*scores)
        environment = report.describe_environment()
        if 'json' in parts:
            document = {
                'configs': {'A': given[0], 'B': given[1], 'changed': changed},
                'environment': environment,
                'measures': [one._asdict() for one in differences],
                'scans': Table(COLUMNS, rows).json(),
            }
            report.write_json(document, parts['json'])
    n_points = sum(row[2] for row in rows)
    shares = [sum(row[2] * row[k] for row in rows) / max(n_points, 1) for k in (3, 4, 5)]
    last = ['all', options.count(len(rows), 'frame'), n_points, *shares]
    title = 'Points with two labels, in the frames with most and in all  [%]'
    tables = [
        comparison.difference_table(scores[0], differences, ['A', 'B']),
        Table(COLUMNS, [*(row for row, *_ in worst), last], title, n_sums=1),
    ]
    print(f'A: {given[0]}, B: {given[1]}', *changed, '', sep='\n')
    lines = [report.machine_line(environment, scores[0].scans[-1].fit)]
    print(report.written(tables, lines, markdown=arguments.markdown))
    if target:
        print(f'drawn: {", ".join(pictures)} in {target}')
    return 0


def _items(arguments: argparse.Namespace) -> tuple[Any, Callable[[Any], KnownScan]]:
    """Return labelled frames, or clouds, and what reads one of them."""
    root, layout = Path(arguments.root), options.scan_layout(arguments)
    if any(root.glob('sequences/*/velodyne')):
        return frames_from_options(arguments), load_kitti
    for name in ('sequences', 'frame_step'):
        if getattr(arguments, name) is not None:
            option = name.replace('_', '-')
            raise DataError(f'--{option}: {root} has no sequences/*/velodyne below it')
    group = root.resolve().stem
    return list_inputs(root, layout), lambda one: KnownScan(group, one.name, one.read().xyz, {})
