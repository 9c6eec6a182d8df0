# Two commands do everything on a fresh machine: make fly, make test.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install fly test lint unit bench clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"companion needs Python 3.11 or newer, this is {v.major}.{v.minor}; name another: make PYTHON=python3.12 install")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python venv failed: on Debian, apt install python3-venv"; exit 1; }
	@echo "installing into $(VENV) ..."
	@PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all]'
	@touch $@

fly: install
	@$(BIN)/companion fly configs/missions/catch.yaml --sitl

test: lint unit

lint: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

unit: install
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not flight"
	$(BIN)/python -m pytest -m flight

bench: install
	$(BIN)/python benchmarks/wire_latency.py

clean:
	rm -rf $(VENV) build *.egg-info
