"""Counts the faults that the tests find: `python test/seeded_faults.py COVERAGE RESULTS ROOM`.

A fault is one edit of core, data or ros, drawn by a fixed seed. The tests that ran its statement
run against it, in a copy of the repository. COVERAGE has the files of `coverage run`, with
`dynamic_context = test_function`: for a module of tests `core/SECONDS_MODULE`, run with
NUMBA_DISABLE_JIT=1, or `rest/SECONDS_MODULE`, without it. RESULTS takes a line of JSON for each
fault; a second run goes on where the first ended. Its draft, beside it, names the faults: copied,
the same faults are run against another version of the tests.
"""

import ast
import contextlib
import importlib
import json
import math
import os
import random
import re
import shutil
import signal
import sqlite3
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parent.parent
NUMBERS = {'core': 90, 'data': 60, 'ros': 50}
SECONDS, MOST_TESTS = 90, 40
# Plain Python warns where hashes of the compiled loops overflow.
OPTIONS = ['-xq', '-p', 'no:cacheprovider', '-m', 'not slow', '--timeout=60']
OPTIONS += ['-W', 'ignore:overflow encountered', '-W', 'ignore:Module already imported']
TURNED = {'<': '>', '>': '<', '<=': '>', '>=': '<', '==': '!=', '!=': '==', 'is': 'is not'}
TURNED |= {'is not': 'is', 'in': 'not in', 'not in': 'in'}
OTHER = {'+': '-', '-': '+', '*': '/', '/': '*', 'and': 'or', 'or': 'and'}


def edits(source):
    """Each fault of a source: its kind, first line of its statement, bytes and new text."""
    text, tree = source.encode(), ast.parse(source)
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def begin(node):
        return starts[node.lineno - 1] + node.col_offset

    def end(node):
        return starts[node.end_lineno - 1] + node.end_col_offset

    def code(node):
        return text[begin(node) : end(node)].decode()

    def between(left, right, table):
        found = re.fullmatch(r'[\s)]*([^\s()]+(?: not| in)?)[\s(]*',
                             text[end(left) : begin(right)].decode())  # fmt: skip
        if found and found[1] in table:
            yield *(end(left) + place for place in found.span(1)), table[found[1]]

    def of_node(node):
        whole = begin(node), end(node)
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], TURNED)
        elif isinstance(node, ast.BinOp):
            yield from between(node.left, node.right, OTHER)
        elif isinstance(node, ast.BoolOp):
            yield from between(*node.values[:2], OTHER)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            yield *whole, code(node.operand)
        elif isinstance(node, ast.Constant) and type(node.value) is int:
            yield *whole, str(node.value + 1)
        elif isinstance(node, ast.Constant) and type(node.value) is float:
            yield *whole, str(node.value * 2.0 or 1.0)
        elif isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
            yield *whole, 'return None'
        elif isinstance(node, ast.AugAssign) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        ):
            yield *whole, 'pass'
        elif isinstance(node, ast.Call) and len(node.args) > 1:
            a, b = node.args[:2]
            if code(a) != code(b) and not isinstance(a, ast.Starred) | isinstance(b, ast.Starred):
                middle = text[end(a) : begin(b)].decode()
                yield begin(a), end(b), code(b) + middle + code(a)

    def visit(node, first):
        if isinstance(node, ast.stmt):
            first = node.lineno
        if isinstance(node, ast.expr | ast.stmt):
            if isinstance(node, ast.Raise) or 'LOGGER' in code(node)[:8]:
                return  # words
            for fault in of_node(node):
                yield type(node).__name__, first, *fault
        for name, value in ast.iter_fields(node):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and name not in ('annotation', 'returns'):
                    yield from visit(child, first)

    return visit(tree, 1)


def draw():
    """The faults: of each room as many as NUMBERS has, of each kind as many where there are."""
    faults = []
    for room, n in NUMBERS.items():
        rng, by_kind, taken = random.Random(46), defaultdict(list), set()
        for path in sorted((TREE / 'gp_ground_seg' / room).rglob('*.py')):
            source = path.read_bytes()
            for kind, first, start, end, new in edits(source.decode()):
                line_start = source.rfind(b'\n', 0, start) + 1
                line_end = source.find(b'\n', end)
                by_kind[kind].append({
                    'file': str(path.relative_to(TREE)), 'kind': kind, 'first': first,
                    'line': source.count(b'\n', 0, start) + 1,
                    'text': source[line_start:line_end].decode(), 'at': start - line_start,
                    'old': source[start:end].decode(), 'new': new,
                })  # fmt: skip
        for kind in by_kind.values():
            rng.shuffle(kind)
        while len(taken) < n:
            for kind in by_kind.values():
                place = kind and (kind[-1]['file'], kind[-1]['line'])
                if kind and place not in taken and len(taken) < n:
                    taken.add(place)
                    faults.append(kind[-1])
                del kind[-1:]
    random.Random(46).shuffle(faults)
    return faults


def tests_of(coverage, fault):
    """The tests that ran its statement, own and fast ones first; modules that did outside them.

    Where none is known to, the modules that name the file: they run it in other processes.
    """
    room, stem = fault['file'].split('/')[1], Path(fault['file']).stem
    wanted = set(range(fault['first'], fault['line'] + 1))
    is_compiled = re.search('/(compiled|gp|pipeline)/', fault['file'])
    tests, modules = [], []
    sides = ['core', 'rest'][room != 'core' : 1 if is_compiled else 2]
    for path in (path for side in sides for path in sorted((coverage / side).iterdir())):
        module, names, is_used = f'test/test_{path.name.partition("_")[2]}.py', set(), False
        with sqlite3.connect(path) as data:
            rows = data.execute(
                'select context, numbits from line_bits join file on file_id = file.id '
                'join context on context_id = context.id where path like ?', ['%/' + fault['file']]
            ).fetchall()  # fmt: skip
        for context, bits in rows:
            is_used |= context != ''
            if any(line // 8 < len(bits) and bits[line // 8] >> line % 8 & 1 for line in wanted):
                named = re.fullmatch(r'test_\w+\.(test_\w+)', context)
                names.add(named[1] if named else context)
        own = {name for name in names if re.fullmatch(r'test_\w+', name)}
        tests += [f'{module}::{name}' for name in sorted(own)]
        # Hypothesis stands between a test and what it draws; a fixture has no context.
        if names - own - {''} or (names == {''} and is_used):
            modules.append(module)
    naming = [
        f'test/{path.name}' for path in TREE.glob('test/test_*.py')
        if re.search(rf'\b{room}\b[^\n]*\b{stem}\b', path.read_text())
    ]  # fmt: skip
    found = tests + modules or sorted(naming)
    found.sort(key=lambda one: f'_{stem}.py' not in one)
    return [one for one in found if (TREE / one.partition(':')[0]).exists()][:MOST_TESTS]


class Finder:
    """Plugin of pytest: the first test that fails."""

    name = ''

    def pytest_runtest_logreport(self, report):
        if report.failed and not self.name:
            self.name = report.nodeid + ' (timeout)' * ('Timeout' in str(report.longrepr))

    pytest_collectreport = pytest_runtest_logreport


def run(fault, tests, copy):
    """Return the test that finds the fault; None if none does, 'undecided' at the time limit."""
    path = copy / fault['file']
    source, old = path.read_bytes(), fault['old'].encode()
    at = source.find(fault['text'].encode()) + fault['at']
    if source.count(fault['text'].encode()) > 1:  # of equal lines the old one
        at = len(b''.join(source.splitlines(keepends=True)[: fault['line'] - 1])) + fault['at']
    if source[at : at + len(old)] != old:
        return 'gone'
    path.write_bytes(source[:at] + fault['new'].encode() + source[at + len(old) :])
    end, answer = time.monotonic() + SECONDS, copy / 'answer'
    answer.unlink(missing_ok=True)
    if not (pid := os.fork()):
        os.setsid()
        os.chdir(copy)
        with open('said', 'w') as said:
            os.dup2(said.fileno(), 1), os.dup2(said.fileno(), 2)
        finder = Finder()
        code = pytest.main([*OPTIONS, *tests], plugins=[finder])
        answer.write_text('' if code in (0, 5) else finder.name or f'exit code {code}')
        os._exit(0)
    while os.waitpid(pid, os.WNOHANG) == (0, 0):
        time.sleep(0.05)
        if time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
            end = math.inf
    with contextlib.suppress(ProcessLookupError):  # what the tests have started
        os.killpg(pid, signal.SIGKILL)
    path.write_bytes(source)
    if end == math.inf:
        return 'undecided'
    return (answer.read_text() or None) if answer.exists() else 'the tests ended'


def main(coverage, results, room):
    """Run the faults of a room that have no result yet."""
    results, draft = Path(results), Path(results).with_suffix('.draft')
    if not draft.exists():
        draft.write_text(json.dumps(draw(), indent=1))
    done = {json.loads(line)['fault'] for line in results.open()} if results.exists() else set()
    copy = results.with_suffix(f'.{room}').absolute()
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(TREE, copy, ignore=shutil.ignore_patterns('.*'))
    sys.path.insert(0, str(copy))
    sys.dont_write_bytecode = True
    os.environ |= {'PYTHONPATH': str(copy), 'PYTHONDONTWRITEBYTECODE': '1'}
    for name in ('hypothesis', 'numpy.testing', 'scipy.spatial', 'scipy.ndimage', 'yaml'):
        importlib.import_module(name)  # once for all faults
    with results.open('a') as file:
        if room == 'core':  # numpy, and the compiled loops as plain Python
            os.environ['NUMBA_DISABLE_JIT'], sys.modules['numba'] = '1', None
        else:
            import gp_ground_seg.core.segmenter

            gp_ground_seg.core.segmenter.warm_up()
        for k, fault in enumerate(json.loads(draft.read_text())):
            if k not in done and f'/{room}/' in fault['file']:
                tests, began = tests_of(Path(coverage), fault), time.monotonic()
                caught = run(fault, tests, copy) if tests else None
                took = round(time.monotonic() - began, 1)
                record = {'fault': k, 'caught': caught, 'seconds': took, 'tests': tests}
                print(json.dumps({**record, **fault}), file=file, flush=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
