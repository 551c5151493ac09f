# Every target makes the virtual environment it needs in .venv; a later call finds it and is quick.
# `make demo` installs what the main job needs, `make test` adds what checks it.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints-cpu.txt

# One thread per test worker: two workers on two cores gain nothing from more, and numba's threads would fight.
ONE_THREAD := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
# The theme prints advertising for itself about MkDocs 2 on every build; it is no warning about our pages.
MKDOCS := NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs

# OSRM's programs, where `make programs` has put them.
export PROBE2ROAD_OSRM ?= $(wildcard $(CURDIR)/.programs/osrm)
export PROBE2ROAD_VALHALLA ?= $(wildcard $(CURDIR)/.programs/valhalla)

.PHONY: help demo test programs format lint types docs docs-serve test-minimum test-all-pythons bench release-check clean

help:
	@echo 'make demo        set up and run the main job on built-in data; results in demo-output/'
	@echo 'make test        set up and run every check'
	@echo 'make programs    install Chromium and OSRM, without which some checks are skipped'
	@echo 'make format      rewrite the code in the style of the formatter'
	@echo 'make docs-serve  show the documentation at http://127.0.0.1:8000'
	@echo 'make test-minimum      run a part of the tests with the oldest dependencies that are declared'
	@echo 'make test-all-pythons  run the same part with every Python that is installed here, 3.11 to 3.13'
	@echo 'make bench             time every stage; results in benchmarks/results/'
	@echo 'make release-check     build what would be released and look into it'
	@echo 'make clean       remove the virtual environment and everything built'

demo: $(VENV)/.core-installed
	$(BIN)/probe2road demo demo-output

# Pytest runs last, so that its summary closes the output. Each worker begins with its own half of the files, so that what a file
# sets up is set up once, and takes from the other's when it is done.
test: lint types docs
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist worksteal

programs: $(VENV)/.dev-installed
	tools/install_programs.sh

lint: $(VENV)/.dev-installed
	$(BIN)/ruff format --check
	$(BIN)/ruff check

types: $(VENV)/.dev-installed
	$(BIN)/mypy

docs: $(VENV)/.dev-installed
	$(MKDOCS) build --strict --quiet

docs-serve: $(VENV)/.dev-installed
	$(MKDOCS) serve

format: $(VENV)/.dev-installed
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

# What is quick, touches every dependency of the core, and compiles little.
QUICK := tests/fleet tests/graph tests/io tests/raster tests/cli tests/test_crs.py tests/test_errors.py tests/test_options.py
WITHOUT_EXTRAS := pytest pytest-xdist hypothesis osmnx duckdb

# Old releases of what we use call what their own dependencies have deprecated since; that is no fault of ours.
test-minimum:
	$(PYTHON) tools/minimum_versions.py --check
	test -d .venv-minimum || $(PYTHON) -m venv .venv-minimum
	.venv-minimum/bin/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints-minimum.txt --editable . $(WITHOUT_EXTRAS)
	$(ONE_THREAD) .venv-minimum/bin/python -m pytest -q -n 2 -W ignore::DeprecationWarning $(QUICK)

test-all-pythons:
	@for version in 3.11 3.12 3.13; do \
		if ! python$$version -c '' 2>/dev/null; then echo "Python $$version: not installed here, left out"; continue; fi; \
		echo "Python $$version"; \
		test -d .venv-$$version || python$$version -m venv .venv-$$version || exit 1; \
		.venv-$$version/bin/python -m pip install --quiet --disable-pip-version-check \
			--editable . $(WITHOUT_EXTRAS) || exit 1; \
		$(ONE_THREAD) .venv-$$version/bin/python -m pytest -q -n 2 $(QUICK) || exit 1; \
	done

bench: $(VENV)/.dev-installed
	$(ONE_THREAD) $(BIN)/python benchmarks/run_all.py

release-check:
	rm -rf dist
	test -d .venv-release || $(PYTHON) -m venv .venv-release
	.venv-release/bin/python -m pip install --quiet --disable-pip-version-check build
	.venv-release/bin/python -m build --quiet --outdir dist
	.venv-release/bin/python tools/check_release.py dist

clean:
	rm -rf $(VENV) .programs .venv-minimum .venv-release .venv-3.1[123] dist site demo-output .mypy_cache .pytest_cache .ruff_cache .hypothesis

# The stamps say what the environment holds; both are redone when pyproject.toml or the constraints change.
$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo 'probe2road needs Python 3.11 or later; name one, for example: make $(MAKECMDGOALS) PYTHON=python3.12'; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.core-installed: pyproject.toml constraints-cpu.txt | $(VENV)/.created
	$(PIP) --editable .
	@touch $@

$(VENV)/.dev-installed: pyproject.toml constraints-cpu.txt | $(VENV)/.created
	$(PIP) --editable '.[dev]'
	@touch $(VENV)/.core-installed $@
