"""What earlier releases had: parameters, commands, options, launch arguments and topics.

Files, commands, the launch file and the library refuse them with the sentence here. A node leaves
them out and warns, for one release. A new line is all that another one needs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

PROGRAM = 'gp-ground-seg'
LAUNCH_FILE = 'ground_segmentation.launch.py'
# By itself or joined to its option; not of a scheduler.
_URL = re.compile(r'(?:-\w=?|--[\w-]+=)?((?!tcp:|tls:)[a-z][a-z0-9+.-]*://.*)', re.IGNORECASE)
REMOVED: dict[str, str] = {
    'learning.mode=every_k': 'use every_frame, or fixed, which takes less time',
    'learning.mode=first_frame': 'use every_frame, or fixed with your values in observation',
    'learning.period': 'leave it out: the mode every_k is gone',
    'learning.scope': 'leave it out: a frame has one set of hyper-parameters',
    'learning.warm_start': 'leave it out: learning starts from the lines of each frame',
    'learning.max_time': 'use learning.max_evaluations',
    'input.max_cloud_size': 'leave it out: clouds of any size are taken',
    'output.max_range': 'leave it out: costmaps have ranges of their own (docs/nav2.md)',
    'output.ground_voxel': 'leave it out: costmaps have voxels of their own (docs/nav2.md)',
    'output.obstacle_voxel': 'leave it out: costmaps have voxels of their own (docs/nav2.md)',
    'diagnostics.max_load': 'use diagnostics.max_latency; clouds that are lost are always a WARN',
    'diagnostics.max_drop_ratio': 'leave it out: clouds that are lost are always a WARN',
    'diagnostics.max_refused_ratio': 'leave it out: a cloud that is refused is always an ERROR',
    'diagnostics.min_quality': 'leave it out: the status model says what is doubtful',
    'diagnostics.recover_after': 'leave it out: a level ends with its cause',
    '~/markers': 'use ~/ground_model: RViz and Foxglove colour it by std or length_scale',
    f'{LAUNCH_FILE} ground': "use launch_ros.actions.SetRemap('ground', TOPIC) before the include",
    f'{LAUNCH_FILE} obstacles': (
        "use launch_ros.actions.SetRemap('obstacles', TOPIC) before the include"
    ),
    f'{LAUNCH_FILE} name': 'use namespace',
    f'{LAUNCH_FILE} respawn': 'start ground_segmentation_node by launch_ros.actions.Node',
    f'{LAUNCH_FILE} respawn_delay': 'start ground_segmentation_node by launch_ros.actions.Node',
    f'{LAUNCH_FILE} bag': 'use ros2 bag play --clock BAG, and use_sim_time:=true',
    f'{LAUNCH_FILE} threads': 'leave it out: a scan takes one thread',
    'two_sensors.launch.py': f'include {LAUNCH_FILE} twice (docs/node.md)',
    'runtime.n_threads': 'leave it out: a scan takes one thread; --workers takes several scans',
    f'{PROGRAM} config diff': (
        f'use diff on two files, each written by {PROGRAM} config dump --config FILE'
    ),
    f'{PROGRAM} bench': (
        f'use {PROGRAM} experiment speed ROOT; for the time on scans without labels, '
        f'{PROGRAM} evaluate INPUT --against NAME'
    ),
    f'{PROGRAM} demo --kitti': (
        f'use {PROGRAM} kitti-to-bag, node and play (docs/tutorial_kitti.md)'
    ),
    f'{PROGRAM} demo --rate': f'use {PROGRAM} play --rate on what the demo has written',
    f'{PROGRAM} experiment departures': (
        f'use {PROGRAM} evaluate ROOT --set NAME=VALUE --against default'
    ),
    f'{PROGRAM} experiment wrong-values': (
        f'use {PROGRAM} evaluate ROOT --set NAME=VALUE --against default'
    ),
    f'{PROGRAM} experiment sensor-pose': (
        f'use {PROGRAM} evaluate ROOT --set sensor.height=VALUE --against default'
    ),
    f'{PROGRAM} experiment coverage': f'use the table of heights of {PROGRAM} evaluate ROOT',
    f'{PROGRAM} experiment pseudo-inputs --plot': 'use the table, or --json FILE',
    f'{PROGRAM} evaluate --per-frame': 'use --json FILE: its rows are the frames',
    f'{PROGRAM} evaluate --worst': 'use --json FILE: its rows are the frames, with their IoU',
    f'{PROGRAM} plot scan --colour': f'use {PROGRAM} tune INPUT, which colours points',
    f'{PROGRAM} plot scan --surface': (
        f'use {PROGRAM} plot segment, or ~/ground_model of the node in RViz'
    ),
    f'{PROGRAM} segment --resume': 'leave it out: what is written already is left out',
    f'{PROGRAM} segment --split': 'select by label: points[label == 1] are ground',
    f'{PROGRAM} segment --surface': (
        'use ground_z and ground_std of each point, or GroundModel of the library (docs/api.md)'
    ),
    f'{PROGRAM} segment --ground-topic': 'use ros2 bag play --remap /ground:=NAME',
    f'{PROGRAM} segment --obstacles-topic': 'use ros2 bag play --remap /obstacles:=NAME',
    f'{PROGRAM} segment --drop': (
        'leave it out: other topics are not copied; ros2 bag convert joins bags'
    ),
    f'{PROGRAM} tune --node': 'use ros2 param load NODE FILE on the file that it writes',
    f'{PROGRAM} --dtype': 'save the numbers as float32, or as .npy, which knows its type',
    f'{PROGRAM} --origin': (
        "subtract it: xyz = points[:, :3] - (X, Y, Z); numpy.save('a.npy', xyz.astype('float32'))"
    ),
    f'{PROGRAM} pose': f'use {PROGRAM} segment INPUT, which prints height and tilt',
    f'{PROGRAM} compare': f'use {PROGRAM} evaluate ROOT --against FILE_OR_PRESET',
    f'{PROGRAM} view': f'use {PROGRAM} tune INPUT, or Foxglove on what segment writes',
    f'{PROGRAM} optimise': f'use {PROGRAM} tune, and {PROGRAM} evaluate ROOT --against FILE',
}
"""What to use instead, by the ``NAME`` of a parameter, by ``NAME=VALUE`` where only a value is
removed, or by the first words of a command line: those of a command, of one below it, or of either
and an option; of an option alone where every command had it; by the launch file and an argument of
it. A topic of the node begins with ``~/``: nothing refuses it, and nothing a launch file."""


def removal(name: str, value: object = None) -> str:
    """Say what to use instead of a name, or of a value of it; empty if it is not removed."""
    for key in (name, f'{name}={value}'):
        if key in REMOVED:
            return f'{key} was removed: {REMOVED[key]}'
    return ''


def removal_of_words(words: Sequence[str]) -> str:
    """Say what to use instead of removed words or URLs of a command line; empty without any."""
    if url := next(filter(None, map(_URL.fullmatch, words)), None):
        return f'{url[1]}: no URLs; mount the folder (s3fs, rclone), or download the file'
    options = (word.partition('=')[0] for word in words if word.startswith('-'))
    starts = [' '.join((PROGRAM, *words[:n])) for n in (0, 1, 2)]
    names = starts + [f'{start} {option}' for option in options for start in starts]
    return next((line for name in names if (line := removal(name))), '')
