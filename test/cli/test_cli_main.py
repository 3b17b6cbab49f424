"""The entry point: every command is there, and none costs what another imports."""

import argparse
import io
import logging
import re
import shlex
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from bag_samples import scan, write_ros2_bag
from cli_runner import error_line
from conftest import REPOSITORY, run_python
from evaluation_samples import write_streets
from foreign_files import pcd

from gp_ground_seg.cli import main as cli
from gp_ground_seg.cli import options
from gp_ground_seg.data import semantic_kitti
from gp_ground_seg.lab import cluster

HEAVY = {'numba', 'scipy', 'matplotlib', 'pandas', 'rosbags', 'rclpy'}


def test_the_help_has_the_purpose_of_each_command(capsys):
    with pytest.raises(SystemExit, match='0'):
        cli.main(['--help'])
    said = ' '.join(capsys.readouterr().out.split())
    assert all(f'{name} {purpose}' in said for name, (_, purpose) in cli.COMMANDS.items())


XYZ = scan()[:-1, :3]
ONE = scan().tobytes()
FILES = {
    'scan.npy': XYZ, 'many/1.npy': XYZ, 'many/2.npy': XYZ, 'good/000000.bin': ONE,
    'root/sequences/00/velodyne/000000.bin': ONE, 'root/sequences/08/velodyne/000000.bin': ONE,
    'six.bin': np.hstack([XYZ, XYZ % 1]).astype('f4').tobytes(), 'bad/cut.bin': bytes(17),
    'scan.txt': b'1 2 3', 'notes.md': b'mine', 'none/a.las': b'', 'taken.pcd': b'mine',
    'old.png': b'mine', 'mine/000000.label': b'mine', 'a.label': b'', 'a#2?.db3': b'',
    'packed.pcd': pcd(data='binary_compressed', body=struct.pack('<II', 9, 48) + bytes(9)),
}  # fmt: skip
MISTAKES = {
    'segmnt A': "COMMAND: invalid choice: 'segmnt' .choose from .*; see gp-",
    'segment': 'the following arguments are required: INPUT; see gp-ground-seg segment --help',
    'segment nowhere.bin': 'nowhere.bin: no such file or folder',
    'segment s3://bucket/kitti -o out': 's3:/bucket/kitti: no such file or folder',
    'segment scan.txt': 'scan.txt: not a scan or bag; accepted are .*; of a text, save x, y, z as',
    'segment none': r'none: no \.bin, .* file in it, and not a rosbag2 folder',
    'segment bad -o new': 'bad/cut.bin: 17 bytes is not a whole number of points',
    'segment bad/cut.bin -o new.label': 'bad/cut.bin: 17 bytes .*: truncated. --columns ch',
    'segment six.bin -o new.label': 'six.bin: read with 4 columns .*: use --columns 6',
    'segment scan.npy --columns 3': '--columns: is for .bin scans, which scan.npy is not',
    'segment drive.mcap --columns 5': '--columns: is for .bin scans',
    'segment A --columns 2': "--columns: '2': must be a whole number, at least 3",
    'segment scan.npy -o taken.pcd': 'taken.pcd: exists already; --force replaces it',
    'segment scan.npy -o scan.npy --force': 'scan.npy: is the input',
    'segment scan.npy -o x.pcd --format ply': 'x.pcd: ends in .pcd, which is not ply',
    'segment scan.npy -o no/a.npy': 'no/a.npy: the folder no does not exist',
    'segment scan.npy -o a.las': r'a.las: must be a folder, or end in \.label, \.pcd',
    'segment scan.npy --topic /a': '--topic: is for bags, which scan.npy is not',
    'segment many -o a.npy': 'a.npy: must be a folder',
    'segment many -o many --force': 'many.*: is the input',
    'segment many scan.npy': 'scan.npy: a second input, where one is taken; for several: for f in',
    'segment good -o notes.md': 'notes.md: must be a folder',
    'segment good -o mine': 'mine/000000.label: exists already; --force',
    'segment root --format ply': '--format ply: a KITTI_ROOT gives .label files',
    'segment root -o x.ply': 'x.ply: must be a folder',
    'segment drive.mcap --workers 2': '--workers: is for scans, not for a bag',
    'segment drive.mcap -o x.bag': '.*only ROS 2 bags are written',
    'segment drive.mcap -o 100%.db3': '.*sqlite3 bag cannot have % in its path',
    'segment a#2?.db3': r'.*sqlite3 bag cannot have # \? in its path',
    'segment drive.mcap -o no/such/x': '.*no/such does not exist',
    'segment drive.mcap -o . --force': '.*is the input, or has it in it',
    'segment A --set a': '--set a: must be NAME=VALUE',
    'segment A --set sensor.hight=1': "unknown .* 'sensor.hight'; did you mean sensor.height",
    'segment A --preset papr': r"unknown preset 'papr'; did you mean paper. \(there are default",
    'segment A --config no.yaml': 'no.yaml: No such file or directory',
    'segment A --workers x': "--workers: 'x': must be a whole number, at least 1; see ",
    'config dmp': "WHAT: invalid choice: 'dmp' .choose from .dump., .check..; see gp-ground-seg c",
    'plot scan scan.npy': 'the following arguments are required: -o/--output; see gp-ground-seg p',
    'plot scan scan.npy -o a.gif': 'a.gif: must end in .png or .pdf or .svg',
    'plot scan scan.npy -o old.png': 'old.png: exists already; --force replaces it',
    'plot scan many -o a.png --frame x': "--frame: 'x': must be a whole number, at least 0",
    'plot scan many -o a.png --frame 2': '--frame 2: must be 0 to 1 here',
    'plot scan drive.mcap -o a.png --frame 3': '--frame 3: must be 0 to 2 here',
    'plot scan scan.npy -o a.png --labels a.label': 'a.label: 0 bytes, expected 7200 for 1800 poi',
    'plot scan scan.npy -o a.png --labels /no.label': '/no.label: ',
    **{
        f'plot scan A -o B --camera={camera}': f"--camera: '{camera}': must be three numbers, up"
        for camera in ('90', '90,30', 'a,b,c', '0,90,20', '0,20,0.5', '0,20,nan')
    },
    'plot segment A -o B': 'the following arguments are required: --segment',
    'plot segment A -o B --segment 1,': "--segment: '1,': must be whole numbers, as 90,91",
    'plot segment A -o B --segment 90;91': "--segment: '90;91': must be whole numbers, as 90,91",
    'plot segment scan.npy -o B.png --segment 180': r'segment 180: must be in \[0, 179\]',
    'plot segment scan.npy -o B.png --segment -1': 'segment -1',
    'evaluate many': 'many: no sequences/.*velodyne folder .*; scans without labels need --agai',
    'evaluate kitti --sequences ,': '.*no sequence has labels, of 00, 08',
    'evaluate kitti --json /no/such/folder/x.json': '/no/such/folder',
    'evaluate kitti --cut=-0.1': "--cut: '-0.1': must be a number, at least 0",
    'evaluate kitti --set sensor.height=0 --peer patchworkpp': '.*set sensor.origin_z above 0',
    'evaluate kitti --against default': '--against default: the same parameters as given',
    'evaluate kitti --against no.yaml': 'no.yaml: No such file',
    'evaluate kitti --against paper --peer patchworkpp': '--peer: not allowed with',
    **{
        f'evaluate scan.npy --against paper {option} 2': f'{option}: '
        for option in ('--sequences', '--frame-step', '--cut', '--workers')
    },
    'experiment': 'the following arguments are required: NAME',
    'experiment moon': "NAME: invalid choice: 'moon'",
    'experiment ablation kitti --seeds 2': '--seeds: is for simulated scans',
    'experiment ablation --frame-step 2': '--frame-step: is for labelled scans',
    'experiment ablation kitti --sequences 07': '.* in it; sequences here: 00, 08',
    'experiment ablation --set length_scale.model=latent2': '.*length_scale.model',
    'experiment scenes --scenes flt': "--scenes: 'flt': must be some of .*, each once",
    'experiment scenes --scenes flat,flat': '--scenes: .*each once',
    'experiment scenes --json notes.md': 'notes.md: exists already; --force',
    'experiment table1': 'the following arguments are required: ROOT',
    'experiment table1 kitti --sequences 08': 'no frame 00000[06] in sequence ',
    # Workers of whole data sets.
    'segment kitti -o out --workers 99999999999': '--workers 9+: .*four for each processor',
    **{
        f'segment kitti -o out --scheduler {address}': f'--scheduler {address}: does not answer'
        for address in ('tcp://127.0.0.1:1', 'tls://127.0.0.1:1', 'somewhere')
    },
    # The name before it is that of a package that is missing.
    **{
        f'{package}! {words}': f'{package} is not installed'
        for package, words in (
            ('distributed', 'segment kitti -o out --workers 1'),
            ('cryptography', 'segment kitti -o out --workers 1'),
            ('distributed', 'segment kitti -o out --scheduler tcp://127.0.0.1:1'),
            ('pandas', 'evaluate kitti'),
            ('pandas', 'experiment steps kitti'),
            ('tabulate', 'evaluate kitti --markdown'),
            ('pypatchworkpp', 'evaluate kitti --peer patchworkpp'),
        )
    },
    'lzf! segment packed.pcd -o out.npy': 'lzf is not installed.*pip install python-neo-lzf$',
    'play nowhere.mcap': 'nowhere.mcap: no such file or folder',
    'play scan.npy': r'scan.npy: not a bag; accepted are ROS 1 \.bag, \.mcap, \.db3 and rosbag2',
    'play A --rate 0': "--rate: '0': must be a number, above 0",
    'play A --rate nan': "--rate: 'nan': must be a number, above 0",
    'demo --frames 0': "--frames: '0': must be a whole number, at least 1",
    'demo --ros-args -r a:=b': 'demo: --ros-args: this command takes none',
    'node -r a:=/x': 'unrecognized arguments: -r a:=/x; see gp-ground-seg --help',
}


@pytest.fixture(scope='module')
def inputs(tmp_path_factory):
    """A folder with inputs of every kind, good and bad ones."""
    folder = tmp_path_factory.mktemp('inputs')
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write = Path.write_bytes if isinstance(content, bytes) else np.save
        write(folder / name, content)
    write_ros2_bag(folder / 'drive.mcap')
    write_streets(folder / 'kitti', s00=3, s08=1)
    return folder


@pytest.mark.parametrize('line', MISTAKES)
def test_mistakes_are_one_line_with_the_next_step_and_change_nothing(
    line, inputs, monkeypatch, capsys
):
    def content():
        return {path: path.is_file() and path.read_bytes() for path in inputs.rglob('*')}

    monkeypatch.chdir(inputs)
    monkeypatch.setattr(semantic_kitti, 'read_file', None)  # they stop before any frame is read
    monkeypatch.setattr(cluster, 'CONNECT_TIMEOUT', 0.5)
    before, (missing, _, words) = content(), line.rpartition('! ')
    if missing:
        monkeypatch.setitem(sys.modules, missing, None)
    assert cli.main(words.split()) == 2
    assert re.match(MISTAKES[line], said := error_line(capsys)), said
    assert content() == before


def parsers_below(parser):
    """Parsers of a command that have none below them, as words of the command line."""
    found = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    below = [child for one in found for child in one.choices.values()]
    return [leaf for child in below for leaf in parsers_below(child)] or [parser]


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_every_help_fits_80_columns_and_its_examples_run(name, capsys, monkeypatch):
    """Also of what is below a command; an example is taken by the parser as it stands."""
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit, match='0'):
        cli.main([name, '--help'])
    assert capsys.readouterr().out.startswith(f'usage: gp-ground-seg {name}')
    parser = cli.build_parser(name)
    for leaf in parsers_below(parser):
        assert [line for line in leaf.format_help().splitlines() if len(line) > 80] == []
        _, mark, text = leaf.epilog.partition('examples:\n')
        examples = re.findall(r'^  (gp-ground-seg .*)$', re.sub(r'\\\n *', '', text), re.MULTILINE)
        assert mark and any(one.startswith(leaf.prog) for one in examples), leaf.prog
        for example in examples:
            # Behind two spaces is what it does, behind > and --ros-args what others read.
            words = shlex.split(re.split(r'  +| > | &$| --ros-args', example)[0])[1:]
            cli.build_parser(words[0]).parse_args(words)
    assert capsys.readouterr().err == ''


ENTRY = 'from gp_ground_seg.cli.main import main; main({})'
SCAN = str(REPOSITORY / 'docs/scans/vls128_street.npz')


@pytest.mark.parametrize(
    ('code', 'heavy'),
    [
        *((ENTRY.format([*words.split()]), HEAVY)
          for words in ('--help', '--version', 'config dump', 'node -h')),
        (ENTRY.format(['segment', SCAN, '-o', 'a.npy']), {'dask', 'distributed', 'rclpy'}),
        ('from gp_ground_seg import *', {'rclpy', 'sensor_msgs', 'matplotlib', 'rosbags', 'tqdm'}),
        ('import gp_ground_seg', HEAVY | {'numpy'}),
    ],
)  # fmt: skip
def test_what_is_not_needed_is_not_imported(code, heavy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = 'print(*sys.modules, file=sys.stderr)'
    script = f'import atexit, sys; atexit.register(lambda: {names}); {code}'
    loaded = {name.split('.')[0] for name in run_python(script)[1].split()}
    assert 'gp_ground_seg' in loaded
    assert not loaded & heavy


@pytest.mark.parametrize('name', ['module://matplotlib_inline.backend_inline', 'ipympl', 'none'])
def test_a_backend_of_a_notebook_is_not_asked_for(name):
    """Importing matplotlib fails where MPLBACKEND is not installed."""
    code = (
        f'{ENTRY.format(["config", "dump"])}; import matplotlib; print(matplotlib.get_backend())'
    )
    assert run_python(code, MPLBACKEND=name)[0].endswith('\nagg\n')


def test_what_the_library_logs_is_said_within_a_command_only(monkeypatch, capsys):
    logger = logging.getLogger('gp_ground_seg')
    before = logger.level, list(logger.handlers)

    def log(_arguments):
        logger.debug('not worth saying')
        logger.info('compiling %s', 'this')
        logger.warning('cannot be kept')

    monkeypatch.setattr('gp_ground_seg.cli.segment.run', log)
    for words in ['segment', 'A'], ['segment', 'A', '--quiet']:
        cli.main(words)
    logger.info('not in a command')
    assert (logger.level, list(logger.handlers)) == before
    notes = ['compiling this', 'cannot be kept', 'cannot be kept']
    assert capsys.readouterr().err == ''.join(f'gp-ground-seg: note: {n}\n' for n in notes)


@pytest.mark.parametrize(
    ('is_terminal', 'quiet', 'least', 'most'),
    [(True, False, 4, 9), (True, True, 0, 0), (False, False, 1, 2)],
)
def test_progress_is_on_standard_error_and_rare_without_a_terminal(
    is_terminal, quiet, least, most, monkeypatch
):
    stderr = io.StringIO()
    stderr.isatty = lambda: is_terminal
    monkeypatch.setattr('sys.stderr', stderr)
    now = [0.0]
    monkeypatch.setattr('tqdm.std.time', lambda: now[0])
    with options.progress('segment', quiet=quiet)(total=4) as bar:
        for _ in range(4):
            now[0] += 0.55 * options.LINE_PERIOD
            bar.update()
    said = stderr.getvalue()
    assert least <= said.count('segment |') == said.count('of 4 frames done') <= most
