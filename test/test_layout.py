"""The shape of the package: which module may import which, and how large things may be."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from conftest import REPOSITORY

PACKAGE = 'gp_ground_seg'

# Each room and those it may import besides itself; what else lies at the root are files.
ROOMS = {
    'core': set(),
    'data': {'core'},
    'ros': {'core', 'data'},
    'lab': {'core', 'data'},
    'cli': {'core', 'data', 'ros', 'lab'},
    '__init__': {'core'},
    '__main__': {'cli'},
}
# The same inside core, of files and folders.
VALUES = {'frame', 'jit', 'errors', 'log'}
STAGES = VALUES | {'parameters', 'pipeline', 'gp'}
CORE = {
    'errors': set(),
    'jit': set(),
    'log': set(),
    'frame': {'errors', 'jit'},
    'parameters': VALUES,
    'pipeline': VALUES | {'parameters'},
    'gp': VALUES | {'parameters', 'pipeline'},
    'result': STAGES,
    'ground_model': STAGES | {'result'},
    'compiled': STAGES,
    'backend': STAGES | {'compiled'},
    'segmenter': STAGES | {'result', 'backend'},
    '__init__': set(),
}

# Packages that only some places import: folders or files, below the package.
ROS = (
    'rclpy ament_index_python builtin_interfaces diagnostic_msgs geometry_msgs nav_msgs '
    'rcl_interfaces rosgraph_msgs sensor_msgs sensor_msgs_py std_msgs tf2_ros visualization_msgs'
)
ONLY_IN = {
    **dict.fromkeys(ROS.split(), ('ros/',)),
    'rosbags': ('data/bags.py',),
    **dict.fromkeys(('dask', 'distributed'), ('lab/scale/cluster.py',)),
    'lzf': ('data/pcd.py',),
    'matplotlib': ('lab/plotting/',),
    'pandas': ('lab/scoring/', 'lab/experiments/'),
    'numba': ('core/jit.py', 'core/compiled/'),
    'viser': ('lab/viewers/html_page.py',),
    'pypatchworkpp': ('lab/scoring/patchworkpp.py',),
}
PRIVATE = ('numba.core', 'numba.np', 'llvmlite')

MAX_LINES, MAX_FILES = 500, 136
MAX_PARAMETERS, MAX_PARAMETERS_COMPILED = 8, 12
MAX_BODY, MAX_BODY_COMPILED = 40, 60
"""Lines of a function, without its docstring."""


def parse(root):
    """Syntax trees of the modules below a folder, by path relative to it."""
    paths = sorted(Path(root).rglob('*.py'))
    return {
        path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding='utf-8'))
        for path in paths
    }


def room_of(path):
    """First part of a path below the package."""
    return path.split('/')[0].removesuffix('.py')


def imports(tree):
    """Names of the imported modules, with the name imported from each appended."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, 'imports are absolute'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == 'require':
            yield ast.literal_eval(node.args[0])


def find_room_violations(trees):
    """Imports of the package that `ROOMS` does not allow, and inside core `CORE`."""
    for path, tree in trees.items():
        room = room_of(path)
        for name in imports(tree):
            top, *parts = name.split('.')
            if top != PACKAGE or not parts:
                continue
            if parts[0] in ROOMS and parts[0] not in ROOMS[room] | {room}:
                yield f'{path}: imports {name}'
            elif room == parts[0] == 'core':
                floor = room_of(path.removeprefix('core/'))
                if parts[1] in CORE and parts[1] not in CORE[floor] | {floor}:
                    yield f'{path}: imports {name}'


def find_foreign_violations(trees):
    """Imports of other packages where they are not allowed, and of their private parts."""
    for path, tree in trees.items():
        for name in imports(tree):
            top = name.split('.')[0]
            if top == PACKAGE:
                continue
            allowed = ONLY_IN.get(top, ('',))
            if not path.startswith(allowed):
                yield f'{path}: imports {name}, which is for {" and ".join(allowed)} only'
            has_underscore = any(part.startswith('_') for part in name.split('.'))
            if (has_underscore and top != '__future__') or name.startswith(PRIVATE):
                yield f'{path}: imports {name}, which is private'


def loaded_by(path, tree, paths):
    """Modules that a module loads with itself: those it names, and packages on the way to them."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            names = [(alias.name, '') for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [(node.module, alias.name) for alias in node.names]
        else:
            continue
        for module, name in names:
            top, *parts = module.split('.')
            if top != PACKAGE:
                continue
            on_the_way = ['/'.join(parts[:n]) for n in range(1, len(parts))]
            named = '/'.join(parts)
            places = [place for place in on_the_way if not path.startswith(f'{place}/')]
            for place in (*places, named, f'{named}/{name}'):
                place = place.strip('/')
                yield from {f'{place}.py', f'{place}/__init__.py'.lstrip('/')} & paths


def find_cycles(trees):
    """Modules that import themselves by way of others when they are loaded."""
    graph = {path: set(loaded_by(path, tree, trees.keys())) for path, tree in trees.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        cycle = error.args[1]
        yield f'{max(cycle)}: imports itself, by way of {cycle}'


def find_long_signatures(trees):
    """Functions with too many parameters."""
    for path, tree in trees.items():
        limit = MAX_PARAMETERS_COMPILED if path.startswith('core/compiled/') else MAX_PARAMETERS
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                given = node.args
                names = [arg.arg for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
                n_parameters = len([name for name in names if name not in ('self', 'cls')])
                if n_parameters > limit:
                    yield f'{path}: {node.name} has {n_parameters} parameters'


def find_long_functions(trees):
    """Functions that do not fit on a screen."""
    for path, tree in trees.items():
        limit = MAX_BODY_COMPILED if path.startswith('core/compiled/') else MAX_BODY
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = node.body[0 if ast.get_docstring(node) is None else 1 :]
                length = node.end_lineno - first[0].lineno + 1 if first else 0
                if length > limit:
                    yield f'{path}: {node.name} has {length} lines'


def is_shared(node):
    """Whether a statement is a function that both backends use, see `gp_ground_seg.core.jit`."""
    return any(ast.unparse(mark) == 'shared' for mark in getattr(node, 'decorator_list', []))


def find_formulas_that_stand_twice(trees):
    """Shared functions that stand again elsewhere, or that one of the backends does not use."""
    places, users = {}, {}
    for path, tree in trees.items():
        side = 'compiled' if path.startswith('core/compiled/') else 'plain'
        for node in tree.body:
            if isinstance(node, ast.FunctionDef):
                places.setdefault(node.name, []).append((path, is_shared(node)))
            elif isinstance(node, ast.Import | ast.ImportFrom):
                continue
            for part in ast.walk(node):
                if isinstance(part, ast.Name | ast.Attribute):
                    name = part.id if isinstance(part, ast.Name) else part.attr
                    users.setdefault(name, set()).update(
                        {'plain', 'compiled'} if is_shared(node) else {side}
                    )
    for name, found in places.items():
        *others, path = [path for path, _ in found]
        if any(shared for _, shared in found) and (others or len(users.get(name, ())) < 2):
            yield f'{path}: {name} is shared, and also in {others}, or used by one backend only'


def find_returned_arrays(trees):
    """Compiled functions called from Python that return more than numbers: see `jit`."""
    entries = {
        ast.unparse(node.args[0]).split('.')[-1]
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == 'jit(entry=True)'
    }
    for path, tree in trees.items():
        for node in ast.walk(tree):
            marks = [ast.unparse(mark) for mark in getattr(node, 'decorator_list', [])]
            is_entry = any('entry=True' in mark for mark in marks)
            if is_entry or ('shared' in marks and node.name in entries):
                names = {n.id for n in ast.walk(node.returns) if isinstance(n, ast.Name)}
                if names - {'bool', 'int', 'float', 'tuple', 'NumbersOfPlane'}:
                    yield f'{path}: {node.name} returns {ast.unparse(node.returns)}'


def find_reordered_sums(trees):
    """Functions that are compiled to add in any order, and that write to arrays: see `jit`."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            decorators = getattr(node, 'decorator_list', [])
            if any('fastmath=True' in ast.unparse(decorator) for decorator in decorators):
                written = [n for n in ast.walk(node) if isinstance(n, ast.Subscript)]
                if any(isinstance(n.ctx, ast.Store) for n in written):
                    yield f'{path}: {node.name} adds in any order, and writes to an array'


CHECKS = (
    find_room_violations,
    find_foreign_violations,
    find_cycles,
    find_long_signatures,
    find_long_functions,
    find_formulas_that_stand_twice,
    find_returned_arrays,
    find_reordered_sums,
)


@pytest.fixture(scope='module')
def trees():
    return parse(REPOSITORY / PACKAGE)


@pytest.mark.parametrize('find', CHECKS)
def test_the_package_keeps_the_rules(find, trees):
    assert {room_of(path) for path in trees} == set(ROOMS)
    in_core = {path.removeprefix('core/') for path in trees if path.startswith('core/')}
    assert {room_of(path) for path in in_core} == set(CORE)
    found = list(find(trees))
    assert not found, '\n'.join(found)


def test_files_are_of_a_size_worth_opening(trees):
    root = REPOSITORY / PACKAGE
    lengths = {path: len((root / path).read_text(encoding='utf-8').splitlines()) for path in trees}
    assert [(path, n) for path, n in lengths.items() if n > MAX_LINES] == []
    assert len(trees) <= MAX_FILES


@pytest.mark.parametrize(
    ('find', 'path', 'source'),
    [
        (find_room_violations, 'core/pipeline/a.py', 'from gp_ground_seg.core.compiled import b'),
        (find_room_violations, 'core/gp/a.py', 'def f():\n    import gp_ground_seg.core.backend'),
        (find_room_violations, 'core/gp/a.py', 'from gp_ground_seg.core import segmenter'),
        (find_room_violations, 'core/__init__.py', 'from gp_ground_seg.core.frame import Label'),
        (find_room_violations, 'lab/plotting/a.py', 'from gp_ground_seg import cli'),
        (find_room_violations, 'ros/a.py', 'from gp_ground_seg.lab.plotting import style'),
        (find_room_violations, 'lab/a.py', 'def f():\n    from gp_ground_seg.ros import node'),
        (find_room_violations, 'data/__init__.py', 'import gp_ground_seg.ros.node'),
        (find_foreign_violations, 'cli/a.py', 'from rclpy.node import Node'),
        (find_foreign_violations, 'data/a.py', 'import rosbags.highlevel'),
        (find_foreign_violations, 'cli/a.py', 'import matplotlib'),
        (find_foreign_violations, 'cli/a.py', "require('dask', 'distributed')"),
        (find_foreign_violations, 'core/gp/a.py', 'from numba import njit'),
        *((find_foreign_violations, 'core/compiled/a.py', f'import {name}') for name in PRIVATE),
        (find_foreign_violations, 'core/gp/a.py', 'from scipy.linalg import _basic'),
        (find_cycles, 'data/b.py', 'from gp_ground_seg.data.a import f'),
        (find_cycles, 'lab/plotting/d.py', 'from gp_ground_seg.lab.plotting import g'),
        (find_cycles, 'lab/plotting/d.py', 'import gp_ground_seg.lab.plotting'),
        (find_cycles, 'core/frame.py', 'from gp_ground_seg import Config'),
        (find_long_signatures, 'core/gp/a.py', 'def f(a, b, c, d, e, /, f, g, *, h, i): ...'),
        (
            find_long_signatures,
            'core/compiled/a.py',
            f'def f({", ".join("abcdefghijklm")}): ...',
        ),
        (
            find_returned_arrays,
            'core/gp/a.py',
            '@jit(entry=True)\ndef f() -> tuple[int, Lines]: ...',
        ),
        (find_long_functions, 'core/a.py', 'def f():\n    """Add."""' + '\n    x += 1' * 41),
        (find_formulas_that_stand_twice, 'core/compiled/d.py', '@shared\ndef formula(x): ...'),
        (find_formulas_that_stand_twice, 'core/gp/d.py', '@shared\ndef other(x): ...'),
        (
            find_returned_arrays,
            'core/gp/f.py',
            '@shared\ndef g() -> Lines: ...\nf = jit(entry=True)(h.g)\n@shared\ndef k(): g()',
        ),
        (find_reordered_sums, 'core/gp/a.py', '@jit(fastmath=True)\ndef f(x, y): x[0] += y[0]'),
    ],
)
def test_a_violation_is_found_and_only_that(find, path, source):
    fabricated = {
        '__init__.py': 'from gp_ground_seg.core.frame import Config',
        'core/frame.py': 'import numpy as np',
        'core/gp/b.py': 'from gp_ground_seg.core.frame import Label\n'
        'def f(a, b, c, d, e, f, g, h): ...',
        'core/gp/c.py': 'def f(self, a, b, c, d, e, f, g, h): import gp_ground_seg.core.gp.c',
        'core/compiled/b.py': 'import numba\nfrom gp_ground_seg.core.gp import b\n'
        '@jit(entry=True, fastmath=True)\ndef f(x) -> tuple[int, float]: return x[0], x[1]',
        'data/a.py': 'from gp_ground_seg.data.b import f',
        'core/compiled/c.py': 'def f(x):\n    """Add."""\n    return c.formula(x)',
        'core/gp/e.py': '@shared\ndef formula(x): ...\ndef f(x): return formula(x)',
        'lab/plotting/__init__.py': 'from gp_ground_seg.lab.plotting.d import f',
        'lab/plotting/b.py': 'def f():\n    from matplotlib.figure import Figure',
        'lab/plotting/d.py': 'from gp_ground_seg.lab.plotting.e import g',
        'lab/plotting/e.py': 'def g(): ...',
        'ros/b.py': 'import rclpy',
    }
    clean = {name: ast.parse(text) for name, text in fabricated.items()}
    assert [found for check in CHECKS for found in check(clean)] == []
    (violation,) = find({**clean, path: ast.parse(source)})
    assert violation.startswith(f'{path}: ')
