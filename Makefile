# Every target creates the .venv that it needs; system packages are installed with apt if possible (root on Debian).
PYTHON ?= python3
BIN := .venv/bin
# Bytecode is always cached: a lab has four processes, and tests start hundreds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test together alone check gen bench system clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /\1|/' | awk -F'|' '{printf "  make %-8s %s\n", $$1, $$2}'

PIP_INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

# On Debian ensurepip is in a separate package.
.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo 'hilrig needs Python 3.11 or newer: make PYTHON=python3.11' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
		|| { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && apt-get install --yes -qq python3-venv; } \
		|| { echo '$(PYTHON) has no ensurepip: install python3-venv (as root), or use make PYTHON=another' >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/ready: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[all]'
	@touch $@

# Compiling all installed packages takes longer than compiling the imported ones on demand.
.venv/dev: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[dev]' --no-compile
	@touch .venv/ready $@

system: ## install system packages for tests and benchmarks (apt, as root)
	@sh scripts/system_packages.sh

demo: .venv/ready ## run the whole rig for 20 s with a controller over Modbus TCP; results in demo-out/
	$(BIN)/hilrig demo

test: .venv/bin/python ## run all checks and tests of CI
	@$(MAKE) --no-print-directory --jobs=2 system .venv/dev
	@$(MAKE) --no-print-directory --jobs=2 check together
	@$(MAKE) --no-print-directory alone

# Tests of real time run alone, one after the other. All others share the cores, with more workers than cores, because
# they often wait for processes; so linear algebra uses one thread per process. On a virtual machine, CPU steal can make a
# test with real processes fail, so failed tests are repeated alone; a real defect fails again.
AGAIN = $(BIN)/pytest --last-failed --last-failed-no-failures none
together alone: export OPENBLAS_NUM_THREADS = 1
together: .venv/dev
	$(BIN)/pytest -n 4 --dist loadfile --no-loadscope-reorder -m "not alone" || $(AGAIN) -m "not alone"
alone: .venv/dev
	$(BIN)/pytest -m alone tests/rig || $(AGAIN) -m alone tests/rig || $(AGAIN) -m alone tests/rig

check: .venv/dev ## format, lint, types, layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy

gen: .venv/dev ## regenerate code and tables from their sources
	$(BIN)/python -m grpc_tools.protoc -I schemas --python_out=schemas --pyi_out=schemas schemas/hilrig_schemas/v1/*.proto
	$(BIN)/python scripts/wire_contract.py
	$(BIN)/python scripts/generate_configuration.py
	$(BIN)/hilrig registers --markdown > docs/registers.md
	$(BIN)/python scripts/generate_conformance.py > docs/modbus-conformance.md

bench: .venv/dev system ## run all benchmarks (nearly an hour); writes docs/performance.md
	$(BIN)/python bench/run_all.py

clean: ## remove everything that was built or installed here
	rm -rf .venv bench/build .mypy_cache .ruff_cache .pytest_cache .hypothesis dist
