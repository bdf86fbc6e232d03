# Two commands on a fresh machine with python3 (>= 3.11, venv), make and a C compiler:
#   make demo    the warehouse AGV, in real time
#   make test    linter, types, tests, documentation

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q

.PHONY: demo demo-short test lint types pytest soak docs bench clean

demo: .venv/examples
	$(BIN)/python examples/warehouse_agv.py

demo-short: .venv/examples
	$(BIN)/python examples/warehouse_agv.py --deterministic

test: lint types pytest

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/mypy

# What asserts on real time runs by itself; all the rest, on all cores.
pytest: .venv/dev
	$(BIN)/python -m pytest -m "not realtime and not soak" --numprocesses auto --dist loadfile
	$(BIN)/python -m pytest -m "realtime and not soak"

soak: .venv/dev
	$(BIN)/python -m pytest -m soak
	$(BIN)/python -m benchmarks agv --soak 10

docs: .venv/dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: .venv/dev
	$(BIN)/python -m benchmarks micro --peers
	$(BIN)/python -m benchmarks agv --peers --plot agv.bench.png
	$(BIN)/python -m benchmarks service --peers
	$(BIN)/python -m benchmarks recording --peers

clean:
	rm -rf .venv .bench site .mypy_cache .pytest_cache .ruff_cache .hypothesis

.venv/examples: .venv/bin/python pyproject.toml
	$(PIP) install -e '.[examples]'
	@touch $@

.venv/dev: .venv/bin/python pyproject.toml
	$(PIP) install -e '.[dev]'
	@touch $@ .venv/examples

.venv/bin/python:
	$(PYTHON) -m venv .venv
