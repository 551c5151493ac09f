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

.PHONY: help demo test format lint types docs docs-serve clean

help:
	@echo 'make demo        set up and run the main job on built-in data; results in demo-output/'
	@echo 'make test        set up and run every check'
	@echo 'make format      rewrite the code in the style of the formatter'
	@echo 'make docs-serve  show the documentation at http://127.0.0.1:8000'
	@echo 'make clean       remove the virtual environment and everything built'

demo: $(VENV)/.core-installed
	$(BIN)/probe2road demo demo-output

# Pytest runs last, so that its summary closes the output.
test: lint types docs
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2

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

clean:
	rm -rf $(VENV) site demo-output .mypy_cache .pytest_cache .ruff_cache .hypothesis

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
