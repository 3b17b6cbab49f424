"""No dead constant, and three rules of compiled code; `make lint` has those of the rooms."""

import ast
from functools import cache
from pathlib import Path

import pytest
from conftest import REPOSITORY

PACKAGE = 'gp_ground_seg'


@cache
def parse(root):
    """Syntax trees of the modules below a folder, by path relative to it."""
    paths = sorted(Path(root).rglob('*.py'))
    return {
        path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding='utf-8'))
        for path in paths
    }


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
                if names - {'bool', 'int', 'float', 'tuple', 'Plane'}:
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


def find_dead_constants(trees):
    """Constants of a module that nothing in the package reads."""
    read = set()
    for node in (node for tree in trees.values() for node in ast.walk(tree)):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            read.add(node.id)
        elif isinstance(node, ast.Attribute):
            read.add(node.attr)
    for path, tree in trees.items():
        targets = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
        for name in (n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)):
            if name not in read and not name.startswith('__'):
                yield f'{path}: {name} is read nowhere'


VIOLATIONS = {
    find_dead_constants: 'ONE = 1',
    find_formulas_that_stand_twice: '@shared\ndef formula(x): ...',
    find_returned_arrays: '@jit(entry=True)\ndef f() -> tuple[int, Lines]: ...',
    find_reordered_sums: '@jit(fastmath=True)\ndef f(x, y): x[0] += y[0]',
}


@pytest.mark.parametrize('find', VIOLATIONS)
def test_the_code_keeps_the_rules(find):
    found = list(find(parse(REPOSITORY / PACKAGE)))
    assert not found, '\n'.join(found)
    (violation,) = find({'core/gp/f.py': ast.parse(VIOLATIONS[find])})
    assert violation.startswith('core/gp/f.py: ')
