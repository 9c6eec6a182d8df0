# Two commands do everything on a fresh machine: make fly, make test.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install fly test lint unit debian bench docs clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"companion needs Python 3.11 or newer, this is {v.major}.{v.minor}; name another: make PYTHON=python3.12 install")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python venv failed: on Debian, apt install python3-venv"; exit 1; }
	@echo "installing into $(VENV) ..."
	@PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all]'
	@touch $@

fly: install
	@$(BIN)/companion fly configs/missions/catch.yaml --sitl

test: debian lint unit

# What tests need beside Python: a real broker and a real browser. Nobody is asked for a password.
debian:
	@PATH="$$PATH:/usr/sbin"; missing=; \
	command -v mosquitto >/dev/null || missing="$$missing mosquitto"; \
	command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || missing="$$missing chromium"; \
	test -n "$$missing" || exit 0; \
	if ! command -v apt-get >/dev/null; then as=none; elif test "$$(id -u)" = 0; then as=; elif sudo -n true 2>/dev/null; then as="sudo -n"; else as=none; fi; \
	if test "$$as" != none; then \
	  echo "installing$$missing ..."; \
	  export DEBIAN_FRONTEND=noninteractive; \
	  { $$as apt-get -qq update && $$as apt-get -qq install -y --no-install-recommends $$missing; } >/dev/null 2>&1 && exit 0; \
	fi; \
	echo "not installed:$$missing; tests that need them are skipped, with CI set they fail (on Debian: apt install$$missing)"

lint: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# In turn: what computes, what waits for real processes, what flies. TESTS=thorough: property tests draw all of their examples.
unit: install
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not flight and not waits" --durations=10
	$(BIN)/python -m pytest -n $$($(BIN)/python -m tests.at_a_time waits) --dist loadgroup -m waits --durations=10
	$(BIN)/python -m pytest -n $$($(BIN)/python -m tests.at_a_time flights) --dist loadgroup -m "flight and not alone" --durations=10
	$(BIN)/python -m pytest -m alone

# 14 minutes, ten of them a hover; one minute of it: make bench BENCH=--quick
bench: install debian
	@$(BIN)/python -m benchmarks $(BENCH)

docs: install
	@$(BIN)/mkdocs build --strict --quiet
	@echo "build/docs/index.html; with search: $(BIN)/python -m http.server --bind 127.0.0.1 --directory build/docs"

clean:
	rm -rf $(VENV) build *.egg-info
