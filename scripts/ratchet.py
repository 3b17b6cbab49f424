"""Counts lines, statements, files and words, and fails above the numbers of pyproject.toml.

`python scripts/ratchet.py` in the repository. What falls is lowered there in the commit that
removes; a number is raised in a commit of its own, whose message says why.
"""

import ast
import sys
from pathlib import Path

try:
    import tomllib
except ImportError:  # Python 3.10; mypy brings it
    import tomli as tomllib

PARTS = {'product': ['gp_ground_seg/**/*.py', 'launch/*.py'], 'tests': ['test/**/*.py']}
PAGES = ['README.md', 'CONTRIBUTING.md', 'docs/**/*.md']


def count(root: Path) -> dict[str, int]:
    """Return what is counted below a folder, by the names of pyproject.toml."""
    found = {}
    for part, patterns in PARTS.items():
        files = [path for pattern in patterns for path in root.glob(pattern)]
        sources = [path.read_text(encoding='utf-8') for path in files]
        nodes = [node for source in sources for node in ast.walk(ast.parse(source))]
        found[f'{part}_lines'] = sum(len(source.splitlines()) for source in sources)
        found[f'{part}_statements'] = sum(isinstance(node, ast.stmt) for node in nodes)
        found[f'{part}_files'] = len(files)
    for name, patterns in {'page_words': PAGES, 'changelog_words': ['CHANGELOG.rst']}.items():
        paths = [path for pattern in patterns for path in root.glob(pattern)]
        found[name] = sum(len(path.read_text(encoding='utf-8').split()) for path in paths)
    return found


def main() -> int:
    """Print each count and its limit; return 1 if one is above, or has no limit."""
    root = Path(__file__).resolve().parent.parent
    limits = tomllib.loads((root / 'pyproject.toml').read_text())['tool']['ratchet']
    code = 0
    for name, n in count(root).items():
        limit = limits.get(name, 0)
        verdict = 'ABOVE: remove some, or commit a higher limit first' if n > limit else ''
        code = max(code, n > limit)
        print(f'{name:18} {n:6} of {limit:6} {verdict}'.rstrip())
    return code


if __name__ == '__main__':
    sys.exit(main())
