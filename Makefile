# Needs only make and Python 3.11 or newer: the first target that runs builds .venv, the others reuse it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.stamp

# jaxlib 0.10.2 can deadlock in batched MJX steps where XLA's thread pool has only two threads.
NPROC ?= 4
export NPROC

# Tests on object storage find moto's S3 server here, where `make moto` has installed it.
MOTO := $(CURDIR)/build/moto
export PATH := $(PATH):$(MOTO)/bin

.PHONY: help demo tables quick matrix moto test test-full lint notebooks docs dist wheel-check clean
.DEFAULT_GOAL := help

help:
	@echo "make demo       shape a cable into a U, an S and a Z; writes runs/demo/report.html"
	@echo "make tables     the paper's tables at a small size; experiments/*.py --full is the rest"
	@echo "make quick      the tests of the pipeline's spine, a minute and a half"
	@echo "make matrix     the same on every corner of the supported versions; writes docs/results/versions.md"
	@echo "make moto       moto's S3 server into build/moto, without which the tests on object storage skip"
	@echo "make test       lint, types and the quick tests"
	@echo "make test-full  lint, types and every test"
	@echo "make lint       ruff and pyright"
	@echo "make notebooks  executes the notebooks as they are and prints their times"
	@echo "make docs       the documentation as a site, site/index.html"
	@echo "make dist       wheel and source distribution, checked, in dist/"
	@echo "make wheel-check  that wheel in clean environments, with README's commands and their times; a quarter to half an hour"
	@echo "make clean      remove .venv and caches (runs/ stays)"

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "cablejax needs Python 3.11 or newer; name one: make PYTHON=/path/to/python3.11"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP)
	$(BIN)/python -m cablejax demo --overwrite

tables: $(STAMP)
	$(BIN)/python experiments/05_dynamics_models.py
	$(BIN)/python experiments/06_stiffness.py
	$(BIN)/python experiments/07_other_simulator.py
	$(BIN)/python experiments/08_random_targets.py
	$(BIN)/python experiments/09_perception.py

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

# Each file in one process. Files of few tests, which are the slow ones, do not come last.
IN_TWO := -n 2 --dist loadfile --no-loadscope-reorder
# One file per stage of the pipeline, from the simulator to the verdict.
SPINE := tests/test_simulate_engines.py tests/test_simulate_equilibrium.py tests/test_dataset_store.py \
	tests/test_dynamics_graph.py tests/test_dynamics_jraph.py tests/test_residual_ridge.py tests/test_bounded_sets.py \
	tests/test_mpc_feasible.py tests/test_control_targets.py tests/test_perceive_mixture.py tests/test_gaplog.py \
	tests/test_diagnose_noise.py tests/test_cli.py

quick: $(STAMP)
	$(BIN)/python -m pytest -m "not slow" $(IN_TWO) $(SPINE)

# Downloads each corner's packages, and its Python where there is none, into build/versions.
matrix: $(STAMP)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet 'uv>=0.9,<1'
	$(BIN)/python benchmarks/versions.py $(SPINE) tests/test_simulate_composite.py tests/test_simulate_plant.py \
		tests/test_perceive_camera.py

# In an environment of its own: its requirements contradict ours.
moto: $(MOTO)/bin/moto_server

$(MOTO)/bin/moto_server:
	$(PYTHON) -m venv $(MOTO)
	$(MOTO)/bin/python -m pip install --disable-pip-version-check --quiet 'moto[server]>=5,<6'

test: lint
	$(BIN)/python -m pytest -m "not slow" $(IN_TWO)

test-full: lint
	$(BIN)/python -m pytest

notebooks: $(STAMP)
	$(BIN)/python benchmarks/notebooks.py

$(VENV)/.docs-stamp: $(STAMP)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt -e '.[docs]'
	@touch $@

# Strict: a broken link, a page outside the navigation or an undocumented public name fails.
docs: $(VENV)/.docs-stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

dist: $(VENV)/.docs-stamp
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*

# In folders of their own; downloads their packages, and a Python where there is none.
wheel-check: dist
	$(BIN)/python -m pip install --disable-pip-version-check --quiet 'uv>=0.9,<1'
	$(BIN)/python benchmarks/wheel.py dist/cablejax-*.whl

clean:
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .hypothesis
