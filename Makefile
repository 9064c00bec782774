# Every target creates the .venv that it needs; system packages are installed with apt if possible (root on Debian).
PYTHON ?= python3
BIN := .venv/bin
# Bytecode files are always written: a lab has four processes, and tests start hundreds of processes.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test test-long together real-time again coverage check gen docs bench system clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1|/' | awk -F'|' '{printf "  make %-9s %s\n", $$1, $$2}'

PIP_INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

# On Debian, ensurepip is in the package python3-venv. The pip of Python 3.11 takes twice as long as a newer one.
.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo 'hilrig needs Python 3.11 or newer: make PYTHON=python3.11' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
		|| { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && apt-get install --yes -qq python3-venv; } \
		|| { echo '$(PYTHON) has no module ensurepip: install python3-venv (as root), or use another interpreter: make PYTHON=python3.12' >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --upgrade pip

.venv/ready: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[all]'
	@touch $@

# Without --no-compile pip compiles all installed modules; tests import, and so compile, only a part of them.
.venv/dev: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[dev]' --no-compile
	@touch .venv/ready $@

system: ## install the system packages of tests and benchmarks (apt, as root)
	@sh scripts/system_packages.sh

demo: .venv/ready ## run the complete rig for 20 s with a Modbus TCP controller; results in demo-out/
	$(BIN)/hilrig demo

test: .venv/bin/python ## run all tests and checks of CI
	@$(MAKE) --no-print-directory --jobs=2 system .venv/dev
	@$(MAKE) --no-print-directory --jobs=2 check together; first=$$?; $(MAKE) --no-print-directory real-time && exit $$first

# Bytecode of all modules, written by one process: otherwise each worker would compile all of them at the same time.
.venv/compiled: .venv/dev
	@$(BIN)/pytest --collect-only --quiet >/dev/null || true
	@touch $@

# Tests of timing run after the others, two at a time. The others have more workers than there are cores, because they
# often wait for processes; so no process spreads its matrices over all cores.
together real-time again coverage: export OPENBLAS_NUM_THREADS = 1
together: .venv/compiled
	$(BIN)/pytest -n 6 --dist loadfile --no-loadscope-reorder -m "not real_time"
real-time: .venv/dev
	$(BIN)/pytest -n 2 --dist loadfile -m real_time tests/rig
again: .venv/dev ## repeat the tests that failed, one after the other
	$(BIN)/pytest --last-failed --last-failed-no-failures none

coverage: .venv/dev ## line and branch coverage by the unit and contract tests; writes htmlcov/
	$(BIN)/pytest -n 2 --dist loadfile --cov --cov-report term --cov-report html tests/unit tests/contract

# Test files that repeat more, or for longer, with HILRIG_LONG.
REPEATED = $(shell grep -lw LONG tests/*/test_*.py)

test-long: .venv/dev ## tests that take minutes: 2,000 forged recordings, packet captures, long outages, random faults
	HILRIG_FORGED_RECORDINGS=2000 HILRIG_FORGED_SEED=$$(date +%s) $(BIN)/pytest tests/unit/test_forged_recordings.py
	HILRIG_BUS_FUZZ_MESSAGES=100000 $(BIN)/pytest tests/rig/test_bus_fuzz.py
	HILRIG_RANDOM_ARMS=100 $(BIN)/pytest tests/unit/test_automatic_substeps.py
	HILRIG_FUZZ_FRAMES=200000 $(BIN)/pytest tests/rig/test_modbus_fuzz.py
	HILRIG_LONG=1 $(BIN)/pytest -m long
	HILRIG_LONG=1 $(BIN)/pytest -m "not long" $(REPEATED)
	$(BIN)/python tests/chaos.py
	$(MAKE) --no-print-directory docs

check: .venv/dev ## check format, lint rules, types and layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy
	$(BIN)/python scripts/check_vocabulary.py

gen: .venv/dev ## generate code and documentation tables from their sources
	$(BIN)/python -m grpc_tools.protoc -I schemas --python_out=schemas --pyi_out=schemas schemas/hilrig_schemas/v1/*.proto
	$(BIN)/python scripts/wire_contract.py
	$(BIN)/python scripts/generate_configuration.py
	$(BIN)/python scripts/generate_json_schemas.py
	$(BIN)/hilrig registers --markdown > docs/registers.md
	$(BIN)/python scripts/generate_conformance.py > docs/modbus-conformance.md
	$(BIN)/python scripts/draw_grading.py

.venv/docs: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[docs]'
	@touch $@

docs: .venv/docs ## build the documentation site in build/docs/
	$(BIN)/sphinx-build -W --keep-going -q -b html docs build/docs

bench: .venv/dev system ## run all benchmarks (up to one hour); writes bench/results/ and docs/performance.md
	$(BIN)/python bench/run_all.py

clean: ## remove everything that was built or installed here
	rm -rf .venv bench/build .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage htmlcov dist build
