"""Run the command-line tools as ``python -m gp_ground_seg``."""

import sys

from gp_ground_seg.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
