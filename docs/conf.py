"""Configuration of Sphinx, for `make docs` and for rosdoc2, which executes this file."""

import os
import re
import sys
from contextlib import redirect_stdout, suppress
from io import StringIO

sys.path.insert(0, os.path.abspath('..'))

from gp_ground_seg import __version__

project = 'gp_ground_seg'
author = 'gp_ground_seg maintainers'
copyright = f'2026, {author}. Licence: Apache-2.0'
version = release = __version__

# Only what rosdoc2 installs as well; it takes the same theme.
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
html_theme = 'sphinx_rtd_theme'
html_theme_options = {'navigation_depth': 3, 'style_external_links': True}
html_static_path = ['_static']
html_css_files = ['wide.css']
html_show_sourcelink = False
exclude_patterns = ['scans']
myst_heading_anchors = 4
autodoc_typehints = 'none'  # docstrings have types with shapes and units
# ROS, where it is not installed: the page names functions that import its messages.
autodoc_mock_imports = ['geometry_msgs', 'rclpy', 'sensor_msgs', 'std_msgs']
autodoc_member_order = 'bysource'
napoleon_google_docstring = False
napoleon_use_ivar = True

HELP = re.compile(r'^<!-- help: (.*) -->$', re.MULTILINE)


def help_of(words):
    """Return what a command prints with --help."""
    from gp_ground_seg.cli.main import main

    os.environ['COLUMNS'] = '80'
    printed = StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        main([*words, '--help'])
    return printed.getvalue()


def insert_code(_app, _page, source):
    """Put what the code says where a page has a comment for it: docs/cli.md."""
    source[0] = HELP.sub(lambda found: f'```text\n{help_of(found[1].split())}```', source[0])


def setup(app):
    """Register the hook, as Sphinx asks for."""
    app.connect('source-read', insert_code)
