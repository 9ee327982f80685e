# The newest that pyproject.toml supports: make setup PYTHON=/usr/bin/python3.11 takes another.
PYTHON ?= $(shell python3 wheels/pythons.py || echo false)
# Both may be elsewhere: make test VENV=FOLDER/venv BUILD=FOLDER/build
VENV := .venv
BUILD := build
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check -q
# CMake, Ninja and CTest come with the environment.
RUN := PATH="$(abspath $(VENV))/bin:$$PATH"
# Most modules are never imported, so Python compiles those that are.
GET := $(PIP) install --no-compile -c constraints.txt
# Only the project itself is built without isolation. The module is built in the folder of the C++ tests, so that the
# library is compiled once.
INSTALL := $(PIP) install --no-deps --no-build-isolation -C build-dir=$(BUILD)/cpp \
  -C cmake.define.TAUEXT_WERROR=ON -C 'build.targets=_core;_core_stub' -e .
# Packages of their own beside the project, found by their entry points; what their tests need is in the extra dev.
PACKAGES := $(patsubst %/pyproject.toml,%,$(wildcard packages/*/pyproject.toml))
# $(call requirements,extras): what the project needs, without the project.
requirements = $(VENV)/bin/python -c 'import sys, tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
  print(*p["dependencies"], *(r for e in sys.argv[1:] for r in p["optional-dependencies"][e]), sep="\n")' $(1)
# An editable install knows the files it was made with, so a new file asks for a new one.
STAMP := $(VENV)/.installed-$(shell find src -name '*.py' | sort | cksum | cut -d' ' -f1)
# Many small systems: threads of the linear algebra only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
# Workers of `make test`, auto: one a core; WORKERS=0 runs all tests in one process.
WORKERS ?= auto
PYTEST = $(VENV)/bin/python -m pytest
FAST_TESTS = $(PYTEST) -n $(WORKERS) --maxprocesses 8 --dist loadfile -m 'not slow and not timing'
CORE := $(shell find cpp/include cpp/src cpp/learn cpp/bindings -type f)

.PHONY: help setup build benches reproduce test test-all lint docs bench bench-train bench-monitor dist test-dist clean
help: ## Show this help
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-13s %s\n", $$1, $$2}'
setup: $(STAMP) ## Environment and build, in .venv
$(STAMP): pyproject.toml constraints.txt CMakeLists.txt $(CORE) $(PACKAGES:=/pyproject.toml)
	@test -d $(VENV) || { set -x; $(PYTHON) -m venv $(VENV); }
	@$(VENV)/bin/python -c 'import sys; print("Python", sys.version.split()[0], "of", sys.base_prefix)'
	$(GET) pip setuptools scikit-build-core nanobind cmake ninja  # pip first: Debian 12's has no -C
	$(call requirements,dev) > $(VENV)/requirements.txt
	$(GET) -r $(VENV)/requirements.txt & $(RUN) $(INSTALL); built=$$?; wait $$! && exit $$built
	# Under LC_ALL=C, Python 3.11 does not start where a .pth file holds a path that is not ASCII.
	sed -i '/^import/!d' $(VENV)/lib/python*/site-packages/_editable_skbc_tauext.pth
	$(GET) --no-deps --no-build-isolation $(addprefix -e ./,$(PACKAGES))
	! test -w src/tauext || cp $(VENV)/lib/python*/site-packages/tauext/_core.pyi src/tauext  # where mypy looks for it
	rm -f $(VENV)/.installed-*
	touch $@
reproduce: setup ## The whole experiment at quick scale; prints where the report is
	$(VENV)/bin/tauext reproduce --scale quick --out runs/quick
build: setup ## The C++ library and its tests
	$(RUN) cmake -S . -B $(BUILD)/cpp -DTAUEXT_TESTS=ON
	$(RUN) cmake --build $(BUILD)/cpp
test: build ## All tests, Python and C++, on every core (WORKERS=0: Python on one)
	$(RUN) ctest --output-on-failure -j $(shell nproc) --test-dir $(BUILD)/cpp
	$(FAST_TESTS)
test-all: build ## The long part of .ci/run: every Python, wheels, slow tests, sanitizers, ... (PARTS="slow fuzz": these)
	$(RUN) VENV=$(VENV) BUILD=$(BUILD) $(VENV)/bin/python tests/long_part.py $(PARTS)
benches: build ## The C++ benchmarks and the soak
	$(RUN) cmake --build $(BUILD)/cpp --target benches
lint: setup ## Style and types of the Python code; fills in the numbers and tables of docs that have changed
	$(VENV)/bin/python docs/fill.py
	$(VENV)/bin/ruff check src tests benchmarks examples docs wheels packages
	$(VENV)/bin/ruff format --check src tests benchmarks examples docs wheels packages
	$(VENV)/bin/mypy
$(VENV)/.docs: pyproject.toml constraints.txt | setup
	$(call requirements,docs) > $(VENV)/requirements-docs.txt
	$(GET) -r $(VENV)/requirements-docs.txt
	touch $@
docs: setup $(VENV)/.docs ## The documentation site, with its links checked; no warning is let through
	rm -rf $(BUILD)/docs docs/reference/made
	$(VENV)/bin/python -m sphinx -n -W --keep-going -q -b html docs $(BUILD)/docs
	$(VENV)/bin/python docs/check_site.py $(BUILD)/docs
bench: setup ## Dynamics sweep, with ratios to Pinocchio and MuJoCo
	$(VENV)/bin/python benchmarks/dynamics.py
bench-train: setup ## Training and evaluation against PyTorch, where it is installed
	$(VENV)/bin/python benchmarks/train.py
bench-monitor: benches ## The monitor in a control loop
	$(VENV)/bin/python benchmarks/monitor.py --bench $(BUILD)/cpp/monitor_bench
dist: ## The sdist and audited wheels for x86-64 and 64-bit Arm, in dist
	$(PYTHON) wheels/make_dist.py
test-dist: ## This machine's wheels in empty environments without a compiler, and docs/install.md's commands in the unpacked sdist
	$(PYTHON) wheels/try_wheels.py
clean: ## Remove builds; recordings and runs stay
	rm -rf $(BUILD) $(VENV) .mypy_cache src/tauext/_core.pyi
