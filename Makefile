# make run | test | test-slow | check | setup
PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: run test test-slow check setup clean

setup: .venv/.ready

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt setuptools wheel
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[dev,bullet,can,zmq,genicam]'
	touch $@

run: setup
	$(BIN)/dualcal run cells/paper.yaml

test: setup
	$(BIN)/python -m pytest -n 2 -m "not slow and not keeps_time"
	$(BIN)/python -m pytest -n 3 -m "not slow and keeps_time"

test-slow: setup
	$(BIN)/python -m pytest -n 2 -m "slow and not keeps_time" --timeout 1800
	$(BIN)/python -m pytest -m "slow and keeps_time" --timeout 1800

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf .venv build *.egg-info
