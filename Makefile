# Every target makes the .venv that it needs; system parts come by apt where that is possible (root on Debian).
PYTHON ?= python3
BIN := .venv/bin
# Compiled sources are kept whatever the environment says: a lab is four processes, and tests start hundreds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test together alone check gen bench system clean
.DEFAULT_GOAL := help

help: ## what there is
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /\1|/' | awk -F'|' '{printf "  make %-8s %s\n", $$1, $$2}'

PIP_INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

# Debian keeps ensurepip in a package of its own.
.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo 'hilrig needs Python 3.11 or newer: make PYTHON=python3.11' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
		|| { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && apt-get install --yes -qq python3-venv; } \
		|| { echo '$(PYTHON) can make no environments: install python3-venv (as root), or make PYTHON=another' >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/ready: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[all]'
	@touch $@

# To compile all of what is installed takes longer than what tests import of it, which is compiled then.
.venv/dev: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP_INSTALL) '.[dev]' --no-compile
	@touch .venv/ready $@

system: ## the system parts that tests and benchmarks use (apt, as root)
	@sh scripts/system_packages.sh

demo: .venv/ready ## the whole rig for 20 s with a controller over real Modbus TCP; results in demo-out/
	$(BIN)/hilrig demo

test: .venv/bin/python ## everything that CI runs
	@$(MAKE) --no-print-directory --jobs=2 system .venv/dev
	@$(MAKE) --no-print-directory --jobs=2 check together
	@$(MAKE) --no-print-directory alone

# What judges real time runs alone, one test after the other; all else shares the cores, with more workers than there are
# cores, for real processes are often waited for; so no process spreads its matrices over all cores. Where the host of a
# virtual machine takes its processors away for a moment, a test of real processes can fail for it: what failed is made
# again, with nothing beside it, and all is there to be read. What fails for a reason fails again.
AGAIN = $(BIN)/pytest --last-failed --last-failed-no-failures none
together alone: export OPENBLAS_NUM_THREADS = 1
together: .venv/dev
	$(BIN)/pytest -n 4 --dist loadfile --no-loadscope-reorder -m "not alone" || $(AGAIN) -m "not alone"
alone: .venv/dev
	$(BIN)/pytest -m alone tests/rig || $(AGAIN) -m alone tests/rig || $(AGAIN) -m alone tests/rig

check: .venv/dev ## format, lint, types, floors
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy

gen: .venv/dev ## generated code and tables, from their sources
	$(BIN)/python -m grpc_tools.protoc -I schemas --python_out=schemas --pyi_out=schemas schemas/hilrig_schemas/v1/*.proto
	$(BIN)/python scripts/wire_contract.py
	$(BIN)/python scripts/generate_configuration.py
	$(BIN)/hilrig registers --markdown > docs/registers.md
	$(BIN)/python scripts/generate_conformance.py > docs/modbus-conformance.md

bench: .venv/dev system ## every benchmark (most of an hour); writes docs/performance.md
	$(BIN)/python bench/run_all.py

clean: ## everything that was built or installed here
	rm -rf .venv bench/build .mypy_cache .ruff_cache .pytest_cache .hypothesis dist
