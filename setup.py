"""Package description for pip and colcon."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'gp_ground_seg'
# `colcon build --symlink-install` runs a link to this file, in a folder without README.md.
README = Path(__file__).resolve().with_name('README.md')

BAGS = ['mcap>=1.5', 'rosbags>=0.11.9']
EVALUATE = ['pandas>=2.1', 'tabulate>=0.9']  # tables, and these as Markdown
FORMATS = ['python-neo-lzf>=0.3']
PLOT = ['matplotlib>=3.6']
SCALE = ['cryptography>=42', 'distributed>=2025.1']
VISER = ['viser>=1.1']
# Jazzy as wheels, for machines without ROS. With ROS from apt, leave this extra out.
ROS = [
    'ros-jazzy-rclpy[fastrtps]>=7.1,<8',
    'ros-jazzy-common-interfaces>=5.3,<6',
    'ros-jazzy-rmw-fastrtps-cpp>=8.4,<9',
]
# `colcon test` runs pytest because it finds it in an extra of the name `test`.
TEST = ['hypothesis>=6.100', 'pytest>=7.4']
# What rosdoc2 installs.
DOCS = ['myst-parser>=3', 'sphinx>=7.2', 'sphinx-rtd-theme>=2']
DEV = [
    *TEST,
    *EVALUATE,
    *FORMATS,
    *SCALE,
    *VISER,
    'codespell[toml]>=2.3',
    'import-linter>=2.10',
    'colcon-common-extensions',
    'flake8>=6',
    'flake8-builtins',
    'flake8-comprehensions',
    'flake8-docstrings',  # and pydocstyle, which ament_pep257 runs
    'flake8-quotes',
    'mypy>=1.10,<2.5',
    'plyfile>=1.0',
    'pypatchworkpp>=1.4',
    'pypcd4>=1.1',
    'pytest-timeout>=2.3',
    'pytest-xdist>=3.7',
    'ruff>=0.6,<0.18',
    'scikit-learn>=1.4',
    'selenium>=4.20',
    'setuptools<80',  # colcon's ament_python build needs `setup.py develop` and `install`
    'twine>=5',
    'types-PyYAML',
    'types-tqdm',
]

setup(
    name=PACKAGE,
    version='0.5.0',  # a literal: catkin_prepare_release writes it here and into package.xml
    description='Ground segmentation of LiDAR scans with two coupled Gaussian processes',
    long_description=README.read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    url='https://example.org/gp_ground_seg',  # a placeholder, as in package.xml and README.md
    project_urls={'Paper': 'https://arxiv.org/abs/2112.05847'},
    author='gp_ground_seg maintainers',
    maintainer='gp_ground_seg maintainers',
    maintainer_email='maintainers@users.noreply.h-seed-aac284b4.example',
    python_requires='>=3.10',
    package_dir={'': '.'},  # an editable install is then a path, found also from above a clone
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', sorted(glob('config/*'))),
        (f'share/{PACKAGE}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'numba>=0.60',
        'PyYAML>=6.0',
        'threadpoolctl>=3.1',
        'tqdm>=4.60',
    ],
    extras_require={
        'bags': BAGS,
        'evaluate': EVALUATE,
        'formats': FORMATS,
        'plot': PLOT,
        'tune': VISER,
        'scale': SCALE,
        'ros': ROS + BAGS + EVALUATE + PLOT,
        'test': TEST,
        'docs': DOCS,
        'dev': DEV,
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'gp-ground-seg = gp_ground_seg.cli.main:main',
            'ground_segmentation_node = gp_ground_seg.cli.node:main',
            'ground_segmentation_lifecycle_node = gp_ground_seg.cli.node:main_managed',
        ],
    },
)
