"""Counts the faults that the tests find: `python test/seeded_faults.py RESULTS ROOM [FILE]`.

A fault is one edit of a statement of a room, or of one of its files, drawn by a fixed seed. The
modules of tests that name its file run against it, in a copy of the repository. RESULTS takes a
line of JSON for each fault; a second run goes on where the first ended. The same code has the
same faults, whatever its tests.
"""

import ast
import contextlib
import copy
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import textwrap
from collections import Counter
from pathlib import Path

TREE = Path(__file__).resolve().parent.parent
NUMBERS = {'core': 90, 'data': 60, 'ros': 50, 'lab': 60, 'cli': 40}
SECONDS = 90
# Plain Python warns where hashes of the compiled loops overflow.
OPTIONS = ['-xq', '-p', 'no:cacheprovider', '-m', 'not slow', '--timeout=60']
OPTIONS += ['-W', 'ignore:overflow encountered', '-W', 'ignore:Module already imported']
NAMES = 'scope', 'first', 'last', 'kind', 'old', 'new'
PAIRS = (ast.Lt, ast.Gt), (ast.LtE, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot)
PAIRS += (ast.In, ast.NotIn), (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or)
TURNED = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}


def spoil(node):
    """Change a node; return whether there was something to change."""
    kind = type(node.ops[0] if isinstance(node, ast.Compare) else getattr(node, 'op', None))
    args = getattr(node, 'args', None)
    if kind in TURNED and isinstance(node, ast.Compare):
        node.ops[0] = TURNED[kind]()
    elif kind in TURNED:
        node.op = TURNED[kind]()
    elif kind in (ast.Not, ast.USub):
        node.operand = ast.UnaryOp(node.op, node.operand)  # twice is not at all
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        node.value = node.value + 1 if type(node.value) is int else node.value * 2.0 or 1.0
    elif isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
        node.value = ast.Constant(None)
    elif isinstance(node, ast.Call) and len(args) > 1 and ast.dump(args[0]) != ast.dump(args[1]):
        args[:2] = args[1::-1]
    else:
        return False
    return True


def own_nodes(node):
    """A statement and its expressions, without those of statements in it and of annotations."""
    yield node
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            is_part = isinstance(child, ast.AST) and not isinstance(child, ast.stmt)
            if is_part and name not in ('annotation', 'returns', 'decorator_list'):
                yield from own_nodes(child)


def faults_in(node):
    """Kind, old and new text of each fault of a statement."""
    old = ast.unparse(node)
    if isinstance(node, ast.Raise) or old.startswith('LOGGER'):
        return  # words
    is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    if is_call or isinstance(node, ast.AugAssign):
        yield 'pass', old, 'pass'
    for k, part in enumerate(own_nodes(node)):
        other = copy.deepcopy(node)
        if spoil([*own_nodes(other)][k]) and ast.unparse(other) != old:
            yield type(part).__name__, old, ast.unparse(other)


def edits(node, scope=''):
    """Each fault of a syntax tree."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        scope += '.' + node.name
    elif isinstance(node, ast.stmt):
        place = scope, node.lineno, node.end_lineno
        for fault in faults_in(node):
            yield dict(zip(NAMES, (*place, *fault), strict=True))
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.match_case | ast.ExceptHandler):
            yield from edits(child, scope)


def draw(room, name):
    """As many faults as NUMBERS has, one in a line, of each kind as many where there are."""
    paths = sorted((TREE / 'gp_ground_seg' / room).rglob(name))
    trees = {str(path.relative_to(TREE)): ast.parse(path.read_text()) for path in paths}
    faults = [{'file': file, **fault} for file, tree in trees.items() for fault in edits(tree)]
    n_of_kind = Counter()
    random.Random(46).shuffle(faults)

    def rank(fault):
        n_of_kind[fault['kind']] += 1
        return n_of_kind[fault['kind']]

    by_line = {(one['file'], one['first']): one for one in sorted(faults, key=rank, reverse=True)}
    return [*reversed(by_line.values())][: NUMBERS[room]]


def tests_of(fault):
    """Modules of tests that name the file, that of the same name first."""
    stem = Path(fault['file']).stem
    named = re.compile(rf'import\b[^\n]*\b{stem}\b|\b{stem}\b[^\n]* import')
    paths = [path for path in TREE.glob('test/**/test_*.py') if named.search(path.read_text())]
    return [str(p.relative_to(TREE)) for p in sorted(paths, key=lambda p: (stem not in p.name, p))]


def run(fault, tests, folder):
    """Return the test that finds the fault; None if none does, 'undecided' at the time limit."""
    path = folder / fault['file']
    source = path.read_text(encoding='utf-8')
    lines, place = source.splitlines(keepends=True), slice(fault['first'] - 1, fault['last'])
    margin, other = re.match('( *)(el(?=if )|)', lines[place][0]).groups()
    lines[place] = textwrap.indent(other + fault['new'], margin) + '\n'
    path.write_text(''.join(lines), encoding='utf-8')
    words = [sys.executable, '-m', 'pytest', *OPTIONS, *tests]
    environment = {**os.environ, 'PYTHONPATH': str(folder), 'PYTHONDONTWRITEBYTECODE': '1'}
    if '/core/' in fault['file']:  # the compiled loops as plain Python
        environment['NUMBA_DISABLE_JIT'] = '1'
    output = subprocess.Popen(
        words, cwd=folder, env=environment, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        said = output.communicate(timeout=SECONDS)[0]
    except subprocess.TimeoutExpired:
        return 'undecided'
    finally:
        with contextlib.suppress(ProcessLookupError):  # what the tests have started
            os.killpg(output.pid, signal.SIGKILL)
        path.write_text(source, encoding='utf-8')
    found = re.search(r'^(?:FAILED|ERROR) (\S+)', said, re.MULTILINE)
    return found[1] if found else None if output.returncode in (0, 5) else 'the tests ended'


def main(results, room, name='*.py'):
    """Run the faults of a room that have no result yet."""
    results = Path(results)
    done = {json.loads(line)['fault'] for line in results.open()} if results.exists() else set()
    folder = results.with_suffix(f'.{room}').absolute()
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(TREE, folder, ignore=shutil.ignore_patterns('.*'))
    if room != 'core':  # else the time that compiling takes would be a finding
        words = [sys.executable, '-m', 'gp_ground_seg', 'warm-up']
        environment = {**os.environ, 'PYTHONPATH': str(folder)}
        subprocess.run(words, cwd=folder, env=environment, check=True)
    with results.open('a') as file:
        for k, fault in enumerate(draw(room, name)):
            if k not in done:
                record = {'fault': k, 'caught': run(fault, tests_of(fault), folder), **fault}
                print(json.dumps(record), file=file, flush=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
