# Every target sets up what it needs: system libraries, the virtual environment .venv, torch, the native module.
# Variables: PYTHON (the Python to build .venv with), TORCH_INDEX_URL (e.g. https://download.pytorch.org/whl/cpu),
#            MAP, HOST, PORT (make serve), PYTEST_ARGS (make test, make test-long).
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-print-directory

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
TORCH_INDEX_URL ?=
MAP ?= runs/demo/map.ply
HOST ?= 127.0.0.1
PORT ?= 8000
PYTEST_ARGS ?=

TORCH_STAMP := $(VENV)/.torch
INSTALL_STAMP := $(VENV)/.installed
WERROR_STAMP := $(VENV)/.werror
MODULES := $(VENV)/.modules
BUILD_TOOLS := 'scikit-build-core>=0.11' 'nanobind>=2.4' 'cmeel-eigen>=3.4' 'cmake>=3.26' 'ninja>=1.11'
NEW_DEPENDENCIES = $(filter pyproject.toml $(TORCH_STAMP),$?)
NATIVE_SOURCES := $(shell find splatbot/native -name '*.cpp' -o -name '*.hpp' -o -name '*.h' -o -name CMakeLists.txt)

.PHONY: help
help: ## this list
	@echo "splatbot: RGB-D streams become a map of 3D Gaussians, on CPUs"
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "  make %-11s %s\n", $$1, $$2 }'

.PHONY: demo
demo: $(INSTALL_STAMP) ## record a synthetic table top, map it, serve it and query it; then see runs/demo/report.html
	$(BIN)/splatbot demo --out runs/demo

.PHONY: serve
serve: $(INSTALL_STAMP) ## HTTP service on a map (MAP=file.ply HOST=127.0.0.1 PORT=8000)
	@test -e "$(MAP)" || { echo "error: $(MAP) does not exist. Fix: run 'make demo' first, or give MAP=path/to/map.ply"; exit 2; }
	$(BIN)/splatbot serve --map $(MAP) --host $(HOST) --port $(PORT)

.PHONY: test
# Files of tests run beside each other, one for each core, the long ones (e2e) first; each process keeps to one thread.
test: export OMP_NUM_THREADS := 1
# Compiled files are kept: each process would compile the tests and their asserts again.
test test-long: export PYTHONDONTWRITEBYTECODE :=
test: $(INSTALL_STAMP) ## the test suite without its long part (14 minutes on 2 cores)
	$(BIN)/python -m pytest -m "not long" --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

.PHONY: test-long
# Long tests run beside each other as those of `make test` do; those that measure time or use all cores follow alone.
test-long: $(INSTALL_STAMP) ## the long tests: end-to-end on real logs, browser, load, sanitizers, wheel and sdist (under an hour)
	.ci/browser-deps.sh
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "long and not alone" --numprocesses auto --maxprocesses 2 \
	  --dist worksteal $(PYTEST_ARGS)
	$(BIN)/python -m pytest -m "long and alone" $(PYTEST_ARGS)

.PHONY: check
check: $(WERROR_STAMP) ## ruff, mypy, layering contract, prose, and the native code with warnings as errors
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.prose

.PHONY: figures
figures: $(INSTALL_STAMP) ## run the commands behind the figures of the documentation, and compare (minutes; needs the test data)
	$(BIN)/python -m tests.figures

CURVES := runs/bench-tracking/tracking.png runs/bench-collision/collision-accuracy.png \
  runs/bench-collision/collision-sigma.png runs/bench-planning/planning-cost.png
.PHONY: curves
curves: $(INSTALL_STAMP) ## draw the curves of README.md again, from the results of splatbot bench tracking, collision and planning
	for name in tracking collision planning; do $(BIN)/splatbot bench $$name --redraw; done
	cp $(CURVES) docs/images/

.PHONY: docs
docs: export NO_MKDOCS_2_WARNING := 1
docs: $(INSTALL_STAMP) ## the documentation as a site without a server: build/site/index.html
	$(BIN)/mkdocs build --strict --config-file docs/site/mkdocs.yml

.PHONY: clean
clean: ## remove the virtual environment, build products and caches; runs/ is kept
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# torch comes first and alone, so that no later dependency decides which build of it is installed.
$(TORCH_STAMP): .ci/system-deps.sh .ci/find-python.sh
	@python=$$(.ci/find-python.sh) && .ci/system-deps.sh "$$python" && \
	  { [ -x $(BIN)/python ] || { echo "creating $(VENV) with $$python"; "$$python" -m venv $(VENV); }; }
	$(PIP) install --upgrade pip
	$(PIP) install 'torch>=2.6,<2.14' $(if $(TORCH_INDEX_URL),--index-url $(TORCH_INDEX_URL))
	@touch $@

# The build tools come before the package, which is then built without isolation: CMake's cache in build/ survives, and
# a change of one C++ file costs one compilation. Dependencies are looked at again only when pyproject.toml changes.
INSTALL_INPUTS = $(TORCH_STAMP) pyproject.toml $(MODULES) $(NATIVE_SOURCES)
define install
$(if $(NEW_DEPENDENCIES),$(PIP) install $(BUILD_TOOLS))
$(PIP) install --no-build-isolation $(if $(NEW_DEPENDENCIES),,--no-deps) $(1) --editable '.[dev]'
@touch $(INSTALL_STAMP) $@
endef

$(INSTALL_STAMP): $(INSTALL_INPUTS)
	$(call install)

# Compiles the same build once more only if the first one had no warnings as errors; CMake's cache keeps the option.
$(WERROR_STAMP): $(INSTALL_INPUTS)
	$(call install,--config-settings=cmake.define.SPLATBOT_WERROR=ON)

# An editable install knows the modules by name: a new, moved or removed one needs a new install. Rewritten only then.
$(MODULES): $(TORCH_STAMP) FORCE
	@find -L splatbot -name '*.py' | LC_ALL=C sort > $@.now
	@cmp -s $@.now $@ && rm $@.now || mv $@.now $@

.PHONY: FORCE
FORCE:
