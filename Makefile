# Needs python3 (3.11 or later, with venv), make, and a package registry. Each target makes what it lacks.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PYTEST_ARGS ?= -n 2
BENCH_ARGS ?=

.PHONY: help demo test nightly lint format bench docs clean core dev

help:
	@echo "make demo     fly a landing on rendered pictures, replay it, write demo/report.html"
	@echo "make test     run the tests"
	@echo "make lint     ruff, mypy, import contract"
	@echo "make bench    run the benchmarks in minutes, against their baselines (real recordings: set DECKFIX_DATA;"
	@echo "              BENCH_ARGS=--full for all flights and repetitions, BENCH_ARGS='--only fleet tune' for some)"
	@echo "make nightly  run the slow statistics"
	@echo "make docs     build the documentation into site/, links checked"

demo: core
	$(BIN)/deckfix demo -o demo --force

test: dev
	$(BIN)/python -m pytest -m "not nightly" $(PYTEST_ARGS)

nightly: dev
	$(BIN)/python -m pytest -m nightly $(PYTEST_ARGS)

lint: dev
	@status=0; \
	for check in "ruff check ." "ruff format --check ." "mypy" "lint-imports"; do \
	  echo "== $$check"; $(BIN)/$$check || status=1; \
	done; exit $$status

format: dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: dev
	$(BIN)/python benchmarks/run.py $(BENCH_ARGS)

docs: dev
	$(BIN)/python docs/reference.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open site/index.html"

clean:
	rm -rf $(VENV) site demo build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The environment: made where it is missing, made anew where it belongs to another folder or Python, brought up
# to date where pyproject.toml is newer. "dev" is "core" with what tests and lints need.
core:
	@$(call environment,.,core)

dev:
	@$(call environment,.[dev],dev)
	@touch $(VENV)/.core

define environment
set -e; \
if ! $(BIN)/pip --version 2>/dev/null | grep -qF "from $(CURDIR)/$(VENV)/"; then \
  $(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "deckfix: needs Python 3.11 or later; make PYTHON=python3.11")'; \
  echo "making $(VENV)"; rm -rf $(VENV); \
  $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "deckfix: python3 has no venv; apt-get install python3-venv" >&2; exit 1; }; \
fi; \
if [ ! $(VENV)/.$(2) -nt pyproject.toml ]; then \
  echo "installing deckfix and what it needs into $(VENV)"; \
  $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable "$(1)"; \
  touch $(VENV)/.$(2); \
fi
endef
