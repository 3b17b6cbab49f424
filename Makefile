# make demo | make test | make test-all | make browser-test | make bench | make node-bench | make colcon | make dist | make lint | make docs: each creates the environment it needs.
PYTHON ?= python3
# Not the .venv of README, which is without ROS.
VENV ?= .venv-dev
BIN := $(VENV)/bin
KITTI ?= $(abspath $(wildcard ../shared/kitti))
# Empty, the variable would be a path to the tests.
WITH_KITTI := $(if $(KITTI),GP_GROUND_SEG_KITTI=$(KITTI))

.PHONY: help demo test test-all chromium browser-test torture bench figures docs node-bench colcon dist lint format generate clean

help:
	@echo 'make demo      a synthetic drive through the node: score, latency and a picture'
	@echo 'make test      the tests, but those marked slow (KITTI=PATH adds labelled frames)'
	@echo 'make test-all  all tests'
	@echo 'make browser-test  the page of tune in a headless Chromium, which root gets by apt'
	@echo 'make torture   hostile clouds, files and messages (TORTURE_SCALE=100 for a night)'
	@echo 'make bench     time per frame by stage, and of Patchwork++ (needs KITTI=PATH)'
	@echo 'make figures   every table and picture of README and docs anew (needs KITTI=PATH; ONLY=word for some)'
	@echo 'make docs      the documentation as HTML, in build/docs'
	@echo 'make node-bench  latency and losses of the node over DDS'
	@echo 'make colcon    colcon build and colcon test (PYTEST_ARGS=... for some tests)'
	@echo 'make dist      the wheel, built, installed and used outside the repository'
	@echo 'make lint      ruff, mypy, import-linter, codespell, and the limits of size'
	@echo 'make format    format the code'
	@echo 'make generate  rewrite the tables of README, config/ and docs/parameters.md'
	@echo 'make clean     remove the environment and build results'

$(VENV)/.python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile 'pip>=23.2' wheel
	@touch $@

$(VENV)/.ros: setup.py $(VENV)/.python
	@echo 'Installing gp_ground_seg, numba, matplotlib and ROS 2 Jazzy from PyPI into $(VENV) ...'
	@$(BIN)/python scripts/install_with_progress.py 211 -e '.[ros]'
	@touch $@

$(VENV)/.dev: setup.py $(VENV)/.ros
	@echo 'Installing what the tests need into $(VENV) ...'
	@$(BIN)/python scripts/install_with_progress.py 100 -e '.[ros,dev]'
	@touch $@

$(VENV)/.docs: setup.py $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	@touch $@

demo: $(VENV)/.ros
	$(BIN)/gp-ground-seg demo --force

# A test that hangs fails after so many seconds, with a traceback. Two processes share the modules,
# in the order of test/conftest.py: one compiles, the other begins with what needs no compiled code.
test: $(VENV)/.dev
	$(WITH_KITTI) $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --timeout=900 -m 'not slow'

# The slow ones run one after the other: some measure time and memory.
test-all: test
	$(WITH_KITTI) $(BIN)/python -m pytest --timeout=3600 -m slow

# The network may fail now and then, and another program may hold the lock.
chromium: APT := -o Acquire::Retries=5 -o DPkg::Lock::Timeout=300
chromium:
	@command -v chromedriver >/dev/null \
		|| { [ "$$(id -u)" = 0 ] && apt-get $(APT) update -qq && apt-get $(APT) install -qq -y chromium-driver; } \
		|| { echo 'Chromium is not installed: sudo apt-get install chromium-driver'; exit 1; }

browser-test: $(VENV)/.dev chromium
	$(BIN)/python -m pytest test/lab/test_browser.py

torture: export TORTURE_SCALE ?= 1
torture: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --timeout=900 --timeout-method=thread \
		test/torture.py test/data/test_files.py -k 'torture or damage'

bench: $(VENV)/.dev
	$(BIN)/gp-ground-seg experiment speed $(KITTI)

figures: $(VENV)/.dev
	$(BIN)/python docs/figures.py $(KITTI) $(ONLY)
	$(BIN)/python docs/generate.py

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going docs build/docs
	@echo 'build/docs/index.html is the first page'

node-bench: $(VENV)/.ros
	$(BIN)/python test/node_bench.py $(KITTI)

# The interpreter of colcon is that of the node; ROS wheels lie below its prefix.
colcon: export AMENT_PREFIX_PATH := $(abspath $(VENV))
colcon: $(VENV)/.dev
	$(BIN)/colcon build --packages-select gp_ground_seg
	$(WITH_KITTI) $(BIN)/colcon test --packages-select gp_ground_seg --return-code-on-test-failure \
		--event-handlers console_direct+ $(if $(PYTEST_ARGS),--pytest-args $(PYTEST_ARGS))
	$(BIN)/colcon test-result --all

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell
	$(BIN)/python -m flake8 --config=test/ament_flake8.ini gp_ground_seg test setup.py
	$(BIN)/python -m pydocstyle --convention=numpy --add-ignore=D100,D101,D102,D103,D104,D105,D106,D107,D404 \
		--match='.*\.py' gp_ground_seg setup.py
	$(BIN)/python scripts/ratchet.py

# What goes to PyPI: built from the sdist, looked at by twine, installed and used outside this repository.
dist: $(VENV)/.dev
	rm -rf build/dist && mkdir -p build/dist/empty
	$(BIN)/python -m pip wheel -q --no-deps --no-build-isolation -w build/dist \
		$$($(BIN)/python setup.py -q sdist -d build/dist && ls -d $(CURDIR)/build/dist/*.tar.gz)
	$(BIN)/python -m twine check --strict build/dist/*.whl build/dist/*.tar.gz
	$(BIN)/python -m pip install -q --no-deps --target build/dist/site build/dist/*.whl
	cd build/dist/empty && PYTHONPATH=../site NUMBA_DISABLE_JIT=1 $(abspath $(BIN))/python -m gp_ground_seg \
		plot scan $(CURDIR)/docs/scans/vls128_street.npz --set runtime.backend=numpy -o scan.png
	cd build/dist/empty && PYTHONPATH=../site $(abspath $(BIN))/python -c 'import gp_ground_seg as g; assert "/site/" in g.__file__'
	ls build/dist/site/share/gp_ground_seg/config/fastdds_large_clouds.xml build/dist/empty/scan.png

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

generate: $(VENV)/.dev
	$(BIN)/python docs/generate.py

clean:
	rm -rf $(VENV) build dist install log .mypy_cache .ruff_cache .pytest_cache .hypothesis
