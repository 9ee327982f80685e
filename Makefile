PYTHON ?= python3.11
VENV := .venv
PIP := $(VENV)/bin/pip --disable-pip-version-check -q
# An editable install knows the files it was made with, so a new file asks for a new one.
STAMP := $(VENV)/.installed-$(shell find src -name '*.py' | sort | cksum | cut -d' ' -f1)

.PHONY: help setup build reproduce test test-all lint bench bench-train clean
help: ## Show this help
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'
setup: $(STAMP) ## Environment and build, in .venv
$(STAMP): pyproject.toml constraints.txt CMakeLists.txt $(shell find cpp -name '*.[ch]pp' ! -path 'cpp/tests/*' ! -path 'cpp/bench/*')
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt scikit-build-core nanobind cmake ninja
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" $(PIP) install -c constraints.txt --no-build-isolation -e '.[dev]'
	rm -f $(VENV)/.installed-*
	touch $@
reproduce: setup ## The whole experiment at quick scale; prints where the report is
	$(VENV)/bin/tauext reproduce --scale quick --out runs/quick
build/cpp/CMakeCache.txt: $(STAMP)
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" cmake -S . -B build/cpp -G Ninja -DTAUEXT_TESTS=ON
build: build/cpp/CMakeCache.txt ## The C++ library, its tests and benchmarks
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" cmake --build build/cpp
test: build ## All tests, Python and C++
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" ctest --test-dir build/cpp --output-on-failure
	$(VENV)/bin/python -m pytest -m 'not slow'
test-all: lint test ## Slow tests, and the C++ tests under the sanitizers
	$(VENV)/bin/python -m pytest -m slow
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" cmake -S . -B build/sanitize -G Ninja -DTAUEXT_TESTS=ON -DTAUEXT_SANITIZE=ON
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" cmake --build build/sanitize
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" ctest --test-dir build/sanitize --output-on-failure
lint: setup ## Style of the Python code
	$(VENV)/bin/ruff check src tests benchmarks
	$(VENV)/bin/ruff format --check src tests benchmarks
bench: build ## Dynamics sweep and network, with ratios to what else one would use
	$(VENV)/bin/python benchmarks/dynamics.py
	build/cpp/tree_bench
	build/cpp/lstm_bench
bench-train: setup ## Training and evaluation against PyTorch, where it is installed
	$(VENV)/bin/python benchmarks/train.py
clean: ## Remove builds; recordings and runs stay
	rm -rf build $(VENV)
