"""The shape of the package: which module may import which, and how large things may be."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from conftest import REPOSITORY

PACKAGE = 'gp_ground_seg'

# Each layer and those it may import besides itself; a layer is a folder, or a file at the root.
VALUES = {'errors', 'jit', 'log', 'frame'}
STAGES = VALUES | {'parameters', 'pipeline', 'gp'}
RESULT = STAGES | {'result', 'ground_model'}
LIBRARY = RESULT | {'compiled', 'backend', 'segmenter'}
TOOLS = LIBRARY | {'data', 'plotting', 'simulation', 'scale', 'evaluation'}
LAYERS = {
    'errors': set(),
    'jit': {'errors'},
    'log': set(),
    'frame': {'errors'},
    'parameters': VALUES,
    'data': VALUES | {'parameters'},
    'pipeline': VALUES | {'parameters'},
    'gp': VALUES | {'parameters', 'pipeline'},
    'simulation': VALUES | {'parameters', 'data'},
    'result': STAGES,
    'ground_model': STAGES | {'result'},
    'compiled': STAGES,
    'backend': STAGES | {'compiled'},
    'segmenter': RESULT | {'backend'},
    'plotting': RESULT | {'data'},
    'scale': LIBRARY | {'data'},
    'evaluation': LIBRARY | {'data', 'simulation', 'scale'},
    'ros': LIBRARY | {'data', 'plotting', 'simulation'},
    'experiments': TOOLS,
    'viewers': TOOLS,
    'cli': TOOLS | {'experiments', 'ros', 'viewers'},
    '__init__': RESULT | {'segmenter'},
    '__main__': {'cli'},
}

# Packages that only some places import: folders or files, below the package.
ROS = (
    'rclpy ament_index_python builtin_interfaces diagnostic_msgs geometry_msgs rcl_interfaces '
    'rosgraph_msgs sensor_msgs sensor_msgs_py std_msgs tf2_ros visualization_msgs'
)
ONLY_IN = {
    **dict.fromkeys(ROS.split(), ('ros/',)),
    'rosbags': ('data/bags.py',),
    **dict.fromkeys(('dask', 'distributed'), ('scale/cluster.py',)),
    'fsspec': ('data/files.py',),
    **dict.fromkeys(('laspy', 'lazrs'), ('data/las.py',)),
    'lzf': ('data/pcd.py',),
    'pyarrow': ('evaluation/report.py',),
    'matplotlib': ('plotting/',),
    'numba': ('jit.py', 'compiled/'),
    'rerun': ('viewers/rerun_view.py',),
    **dict.fromkeys(('viser', 'trimesh'), ('viewers/html_page.py',)),
    'optuna': ('experiments/optimise.py',),
    'imageio': ('plotting/',),
    'argcomplete': ('cli/main.py',),
    'pypatchworkpp': ('evaluation/patchworkpp.py',),
}
PRIVATE = ('numba.core', 'numba.np', 'llvmlite')

MAX_LINES, MAX_AT_ROOT = 400, 12
MAX_PARAMETERS, MAX_PARAMETERS_COMPILED = 8, 12


def parse(root):
    """Syntax trees of the modules below a folder, by path relative to it."""
    paths = sorted(Path(root).rglob('*.py'))
    return {
        path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding='utf-8'))
        for path in paths
    }


def layer_of(path):
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


def find_layer_violations(trees):
    """Imports of the package that `LAYERS` does not allow."""
    for path, tree in trees.items():
        layer = layer_of(path)
        for name in imports(tree):
            top, _, rest = name.partition('.')
            target = rest.split('.')[0]
            if top == PACKAGE and target in LAYERS and target not in LAYERS[layer] | {layer}:
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


def find_cycles(trees):
    """Modules that import themselves by way of others when they are loaded."""
    graph = {}
    for path, tree in trees.items():
        at_load = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        names = imports(ast.Module(at_load, []))
        modules = [name.removeprefix(f'{PACKAGE}.').replace('.', '/') for name in names]
        found = {f'{part}.py' for name in modules for part in (name, name.rpartition('/')[0])}
        graph[path] = found & trees.keys()
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        cycle = error.args[1]
        yield f'{min(cycle)}: imports itself, by way of {cycle}'


def find_long_signatures(trees):
    """Functions with too many parameters."""
    for path, tree in trees.items():
        limit = MAX_PARAMETERS_COMPILED if layer_of(path) == 'compiled' else MAX_PARAMETERS
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                given = node.args
                names = [arg.arg for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
                n_parameters = len([name for name in names if name not in ('self', 'cls')])
                if n_parameters > limit:
                    yield f'{path}: {node.name} has {n_parameters} parameters'


def find_returned_arrays(trees):
    """Compiled functions called from Python that return more than numbers: see `jit`."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            called = getattr(node, 'decorator_list', [])
            if any('entry=True' in ast.unparse(decorator) for decorator in called):
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
    find_layer_violations,
    find_foreign_violations,
    find_cycles,
    find_long_signatures,
    find_returned_arrays,
    find_reordered_sums,
)


@pytest.fixture(scope='module')
def trees():
    return parse(REPOSITORY / PACKAGE)


@pytest.mark.parametrize('find', CHECKS)
def test_the_package_keeps_the_rules(find, trees):
    assert {layer_of(path) for path in trees} == set(LAYERS)
    found = list(find(trees))
    assert not found, '\n'.join(found)


def test_files_are_of_a_size_worth_opening(trees):
    root = REPOSITORY / PACKAGE
    lengths = {path: len((root / path).read_text(encoding='utf-8').splitlines()) for path in trees}
    assert [(path, n) for path, n in lengths.items() if n > MAX_LINES] == []
    assert len([path for path in trees if '/' not in path]) <= MAX_AT_ROOT


@pytest.mark.parametrize(
    ('find', 'path', 'source'),
    [
        (find_layer_violations, 'pipeline/a.py', 'from gp_ground_seg.compiled import backend'),
        (find_layer_violations, 'gp/a.py', 'def f():\n    import gp_ground_seg.backend'),
        (find_layer_violations, 'plotting/a.py', 'from gp_ground_seg import evaluation'),
        (find_foreign_violations, 'cli/a.py', 'from rclpy.node import Node'),
        (find_foreign_violations, 'data/a.py', 'import rosbags.highlevel'),
        (find_foreign_violations, 'cli/a.py', 'import matplotlib'),
        (find_foreign_violations, 'cli/a.py', "require('optuna', 'tune')"),
        (find_foreign_violations, 'gp/a.py', 'from numba import njit'),
        (find_foreign_violations, 'compiled/a.py', 'from numba.core import types'),
        (find_foreign_violations, 'compiled/a.py', 'import llvmlite'),
        (find_foreign_violations, 'gp/a.py', 'from scipy.linalg import _basic'),
        (find_cycles, 'frame.py', 'from gp_ground_seg.gp.b import f'),
        (find_long_signatures, 'gp/a.py', 'def f(a, b, c, d, e, /, f, g, *, h, i): ...'),
        (find_long_signatures, 'compiled/a.py', f'def f({", ".join("abcdefghijklm")}): ...'),
        (find_returned_arrays, 'gp/a.py', '@jit(entry=True)\ndef f() -> tuple[int, Lines]: ...'),
        (find_reordered_sums, 'gp/a.py', '@jit(fastmath=True)\ndef f(x, y): x[0] += y[0]'),
    ],
)
def test_a_violation_is_found_and_only_that(find, path, source):
    fabricated = {
        'frame.py': 'import numpy as np',
        'gp/b.py': 'from gp_ground_seg.frame import Label\ndef f(a, b, c, d, e, f, g, h): ...',
        'gp/c.py': 'def f(self, a, b, c, d, e, f, g, h): import gp_ground_seg.gp.c',
        'compiled/b.py': 'import numba\nfrom gp_ground_seg.gp import b\n'
        '@jit(entry=True, fastmath=True)\ndef f(x) -> tuple[int, float]: return x[0], x[1]',
        'plotting/b.py': 'def f():\n    from matplotlib.figure import Figure',
        'ros/b.py': 'import rclpy',
    }
    clean = {name: ast.parse(text) for name, text in fabricated.items()}
    assert [found for check in CHECKS for found in check(clean)] == []
    (violation,) = find({**clean, path: ast.parse(source)})
    assert violation.startswith(f'{path}: ')
