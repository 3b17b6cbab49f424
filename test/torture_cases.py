"""What the scripts of the torture campaign share."""

import contextlib
import io
import sys

from gp_ground_seg.cli import main as cli


def answer(words):
    """Exit code, stdout and stderr of a command in this process."""
    said, errors = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(errors):
            code = cli.main([str(word) for word in words])
    except SystemExit as stop:
        code = stop.code
    return code, said.getvalue(), errors.getvalue()


def run_cases(run_case):
    """Run the cases `python SCRIPT FIRST STOP` asks for, print a line for each that fails, exit.

    `run_case` takes the number of a case and returns what is wrong, or None. The last line is
    the number of the case at work, so that a crash shows which one it was.
    """
    n_failed = 0
    for number in range(*map(int, sys.argv[1:3])):
        print(f'\r{number}', end='', flush=True)
        try:
            wrong = run_case(number)
        except Exception as error:
            wrong = f'{type(error).__name__}: {error}'
        if wrong:
            n_failed += 1
            print(f'\rcase {number}: {wrong}', flush=True)
    print()
    sys.exit(1 if n_failed else 0)
