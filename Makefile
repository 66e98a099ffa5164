# The whole project in a few words: `make help`.
#
# Everything below builds what it needs. The first run makes a virtual environment in .venv,
# compiles the Rust extension and installs the Python packages (torch is the large one);
# later runs start at once.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= outputs
# Tests run on up to four cores, a file of them on one. PYTEST takes more options.
PYTEST ?= --numprocesses=auto --maxprocesses=4 --dist=loadfile
RUST_SOURCES := $(shell find crates -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-rust test-python quick bench lint lint-rust lint-python format clean

help: ## Show this list
	@echo "HVF: hierarchical visual foresight"
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | grep -v '(internal)' | awk 'BEGIN {FS = ":.*## "}; {printf "  make %-8s %s\n", $$1, $$2}'

$(VENV)/.python: ## (internal) virtual environment
	@command -v cargo >/dev/null || { echo "error: cargo not found; install Rust 1.89 or newer (https://rustup.rs)"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "error: Python 3.10 or newer is needed"; exit 1; }
	@echo "== set-up 1/3: virtual environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV) || { echo "error: on Debian, apt install python3-venv"; exit 1; }
	@touch $@

$(VENV)/.maturin: $(VENV)/.python
	@echo "== set-up 2/3: maturin"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip "maturin>=1.9,<2"
	@touch $@

$(VENV)/.extension: $(VENV)/.maturin pyproject.toml $(RUST_SOURCES)
	@echo "== set-up 3/3: Rust extension and Python packages (the first time: several minutes, torch is 5 GB)"
	@PIP_QUIET=1 VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/maturin develop --release --extras dev --quiet
	@touch $@

setup: $(VENV)/.extension ## Make the virtual environment, build and install everything

demo: setup ## Reach goal images in the maze with the shipped models; writes pictures
	@$(BIN)/hvf demo maze --out $(OUT)/demo

test: test-rust test-python ## Build and run all tests (cargo and pytest)

test-rust: ## (internal) cargo's tests, those in the documentation and the example
	cargo test --release --quiet -p hvf-core
	cargo run --release --quiet -p hvf-core --example point_mass

test-python: setup ## (internal) pytest
	$(BIN)/python -m pytest $(PYTEST)

quick: setup ## Build and run the tests in Python that do not take long
	$(BIN)/python -m pytest $(PYTEST) -m "not slow"

bench: setup ## Throughput of maze, costs and planner; ratios to numpy and torch; a JSON of it all
	$(BIN)/python benchmarks/run.py --out $(OUT)/bench.json

lint: lint-rust lint-python ## Formatting, clippy, ruff, mypy, stub

lint-rust: ## (internal) cargo fmt, clippy, rustdoc
	cargo fmt --all --check
	cargo clippy --release --all-targets --quiet -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --no-deps --quiet -p hvf-core

lint-python: setup ## (internal) ruff, mypy, stub against module
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest hvf_core --mypy-config-file pyproject.toml \
		--allowlist tests/stubtest.allowlist

format: setup ## Rewrite the sources as lint wants them
	cargo fmt --all
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

clean: ## Remove builds and outputs (keeps .venv and data)
	rm -rf target $(OUT) .pytest_cache .mypy_cache .ruff_cache .hypothesis
