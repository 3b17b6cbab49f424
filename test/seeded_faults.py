"""Counts the faults that the tests find: `python test/seeded_faults.py COVERAGE RESULTS ROOM`.

A fault is one edit of a room, drawn by a fixed seed. The tests that ran its statement run against
it, in a copy of the repository. COVERAGE has the files of `coverage run`, with `dynamic_context =
test_function`: for a module of tests `core/SECONDS_MODULE`, run with NUMBA_DISABLE_JIT=1, or
`rest/SECONDS_MODULE`, without it. RESULTS takes a line of JSON for each fault; a second run goes
on where the first ended. Its draft, beside it, names the faults: copied, the same faults are run
against another version, but for those whose statement is gone.
"""

import ast
import contextlib
import itertools
import json
import os
import random
import re
import shutil
import signal
import sqlite3
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parent.parent
NUMBERS = {'core': 90, 'data': 60, 'ros': 50, 'lab': 60, 'cli': 40}
SECONDS, MOST_TESTS = 90, 40
# Plain Python warns where hashes of the compiled loops overflow.
OPTIONS = ['-xq', '-p', 'no:cacheprovider', '-m', 'not slow', '--timeout=60']
OPTIONS += ['-W', 'ignore:overflow encountered', '-W', 'ignore:Module already imported']
SAME = ('kind', 'text', 'at', 'new')  # of a statement that was moved
TURNED = {'<': '>', '>': '<', '<=': '>', '>=': '<', '==': '!=', '!=': '==', 'is': 'is not'}
TURNED |= {'is not': 'is', 'in': 'not in', 'not in': 'in'}
TURNED |= {'+': '-', '-': '+', '*': '/', '/': '*', 'and': 'or', 'or': 'and'}


def edits(path):
    """Each fault of a file; `nth` counts equal ones of a function."""
    text, seen = path.read_bytes(), Counter()
    starts = [0, *itertools.accumulate(map(len, text.splitlines(keepends=True)))]

    def begin(node):
        return starts[node.lineno - 1] + node.col_offset

    def end(node):
        return starts[node.end_lineno - 1] + node.end_col_offset

    def code(node):
        return text[begin(node) : end(node)].decode()

    def between(left, right):
        found = re.fullmatch(r'[\s)]*([^\s()]+(?: not| in)?)[\s(]*',
                             text[end(left) : begin(right)].decode())  # fmt: skip
        if found and found[1] in TURNED:
            yield *(end(left) + place for place in found.span(1)), TURNED[found[1]]

    def of_node(node):
        whole = begin(node), end(node)
        parts = [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
        is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        if isinstance(node, ast.BinOp | ast.BoolOp) or len(getattr(node, 'ops', [])) == 1:
            yield from between(*parts[:2])
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            yield *whole, code(node.operand)
        elif isinstance(node, ast.Constant) and type(node.value) is int:
            yield *whole, str(node.value + 1)
        elif isinstance(node, ast.Constant) and type(node.value) is float:
            yield *whole, str(node.value * 2.0 or 1.0)
        elif isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
            yield *whole, 'return None'
        elif is_call or isinstance(node, ast.AugAssign):
            yield *whole, 'pass'
        elif isinstance(node, ast.Call) and len(node.args) > 1:
            a, b = node.args[:2]
            if code(a) != code(b) and not isinstance(a, ast.Starred) | isinstance(b, ast.Starred):
                yield begin(a), end(b), code(b) + text[end(a) : begin(b)].decode() + code(a)

    def record(node, scope, first, start, end, new):
        lines = text[text.rfind(b'\n', 0, start) + 1 : text.find(b'\n', end)].decode()
        fault = {
            'file': str(path.relative_to(TREE)), 'kind': type(node).__name__, 'scope': scope,
            'first': first, 'line': text.count(b'\n', 0, start) + 1, 'start': start,
            'text': ' '.join(lines.split()), 'at': len(text[:start].split(b'\n')[-1].lstrip()),
            'old': text[start:end].decode(), 'new': new,
        }  # fmt: skip
        seen[same := (scope, *(fault[key] for key in SAME))] += 1
        return {**fault, 'nth': seen[same]}

    def visit(node, first, scope):
        if isinstance(node, ast.stmt):
            first = node.lineno
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            scope += '.' + node.name
        if isinstance(node, ast.expr | ast.stmt):
            if isinstance(node, ast.Raise) or 'LOGGER' in code(node)[:8]:
                return  # words
            for fault in of_node(node):
                yield record(node, scope, first, *fault)
        for name, value in ast.iter_fields(node):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and name not in ('annotation', 'returns'):
                    yield from visit(child, first, scope)

    return visit(ast.parse(text), 1, '')


def faults_of(room):
    """Each fault of a room."""
    paths = sorted((TREE / 'gp_ground_seg' / room).rglob('*.py'))
    return [fault for path in paths for fault in edits(path)]


def draw():
    """The faults: of each room as many as NUMBERS has, of each kind as many where there are."""
    faults = []
    for room, n in NUMBERS.items():
        rng, by_kind, taken = random.Random(46), defaultdict(list), {}
        for fault in faults_of(room):
            by_kind[fault['kind']].append(fault)
        for kind in by_kind.values():
            rng.shuffle(kind)
        while len(taken) < n:
            for kind in by_kind.values():
                if kind and len(taken) < n:
                    fault = kind.pop()
                    taken.setdefault((fault['file'], fault['line']), fault)
        faults += taken.values()
    random.Random(46).shuffle(faults)
    return faults


def find(fault, faults):
    """The fault as it is today: in its function, or where its room has it once; None if gone."""
    for keys in (('file', 'scope', *SAME), ('scope', *SAME), SAME):
        found = [one for one in faults if all(one[key] == fault[key] for key in keys)]
        if found and (len(found) == 1 or 'file' in keys):
            return found[min(fault['nth'], len(found)) - 1]
    return None


def tests_of(coverage, fault):
    """The tests that ran its statement, own and fast ones first; modules that did outside them.

    Where none is known to, the modules that name the file: they run it in other processes.
    """
    room, stem = fault['file'].split('/')[1], Path(fault['file']).stem
    wanted = set(range(fault['first'], fault['line'] + 1))
    is_compiled = re.search('/(compiled|gp|pipeline)/', fault['file'])
    tests, modules = [], []
    where = {path.stem: str(path.relative_to(TREE)) for path in TREE.glob('test/**/test_*.py')}
    sides = ['core', 'rest'][room != 'core' : 1 if is_compiled else 2]
    for path in (path for side in sides for path in sorted((coverage / side).iterdir())):
        module = where.get(f'test_{path.name.partition("_")[2]}', 'gone')
        names, is_used = set(), False
        with sqlite3.connect(path) as data:
            rows = data.execute(
                'select context, numbits from line_bits join file on file_id = file.id '
                'join context on context_id = context.id where path like ?', ['%/' + fault['file']]
            ).fetchall()  # fmt: skip
        for context, bits in rows:
            is_used |= context != ''
            if any(line // 8 < len(bits) and bits[line // 8] >> line % 8 & 1 for line in wanted):
                names.add(re.sub(r'^test_\w+\.(?=test_\w+$)', '', context))
        own = {name for name in names if re.fullmatch(r'test_\w+', name)}
        tests += [f'{module}::{name}' for name in sorted(own)]
        # Hypothesis stands between a test and what it draws; a fixture has no context.
        if names - own - {''} or (names == {''} and is_used):
            modules.append(module)
    named = re.compile(rf'\b{room}\b[^\n]*\b{stem}\b')
    naming = [name for name in where.values() if named.search((TREE / name).read_text())]
    found = [one for one in tests + modules if one[:4] != 'gone'] or sorted(naming)
    return sorted(found, key=lambda one: f'_{stem}.py' not in one)[:MOST_TESTS]


class Finder:
    """Plugin of pytest: the first test that fails."""

    name = ''

    def pytest_runtest_logreport(self, report):
        if report.failed and not Finder.name:
            Finder.name = report.nodeid + ' (timeout)' * ('Timeout' in str(report.longrepr))

    pytest_collectreport = pytest_runtest_logreport


def run(fault, tests, copy):
    """Return the test that finds the fault; None if none does, 'undecided' at the time limit."""
    path = copy / fault['file']
    source, start = path.read_bytes(), fault['start']
    end = start + len(fault['old'].encode())
    path.write_bytes(source[:start] + fault['new'].encode() + source[end:])
    limit, answer = time.monotonic() + SECONDS, copy / 'answer'
    answer.unlink(missing_ok=True)
    if not (pid := os.fork()):
        os.setsid()
        os.chdir(copy)
        with open('said', 'w') as said:
            os.dup2(said.fileno(), 1), os.dup2(said.fileno(), 2)
        code = pytest.main([*OPTIONS, *tests], plugins=[Finder()])
        answer.write_text('' if code in (0, 5) else Finder.name or f'exit code {code}')
        os._exit(0)
    while os.waitpid(pid, os.WNOHANG) == (0, 0):
        time.sleep(0.05)
        if time.monotonic() > limit:
            os.killpg(pid, signal.SIGKILL)
    with contextlib.suppress(ProcessLookupError):  # what the tests have started
        os.killpg(pid, signal.SIGKILL)
    path.write_bytes(source)
    if answer.exists():
        return answer.read_text() or None
    return 'undecided' if time.monotonic() > limit else 'the tests ended'


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
        __import__(name)  # once for all faults
    with results.open('a') as file:
        if room == 'core':  # numpy, and the compiled loops as plain Python
            os.environ['NUMBA_DISABLE_JIT'], sys.modules['numba'] = '1', None
        else:
            import gp_ground_seg.core.segmenter

            gp_ground_seg.core.segmenter.warm_up()
        for k, fault in enumerate(json.loads(draft.read_text())):
            if k not in done and f'/{room}/' in fault['file']:
                now, began = find(fault, faults_of(room)), time.monotonic()
                tests = tests_of(Path(coverage), now) if now else []
                caught = run(now, tests, copy) if tests else None if now else 'gone'
                record = {'fault': k, 'caught': caught, 'now': now, 'tests': tests}
                record['seconds'] = round(time.monotonic() - began, 1)
                print(json.dumps({**record, **fault}), file=file, flush=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
