# Two commands do everything on a fresh machine: make fly, make test.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
MINUTES ?= 10
FIGURES ?= build/figures
# Without bytecode each of some hundred processes would compile the project anew.
unexport PYTHONDONTWRITEBYTECODE
# All targets run the source, also after make compile.
export PYTHONPATH := $(CURDIR)

.PHONY: install lock audit fly press intercept compile test lint explore mutants debian bench figures docs clean

install: $(STAMP)

# uv takes a quarter of pip's time. It does not read pip's settings: where it cannot install, pip does.
$(STAMP): pyproject.toml requirements/uv.txt requirements/all.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"companion needs Python 3.11 or newer, this is {v.major}.{v.minor}; name another: make PYTHON=python3.12 install")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python venv failed: on Debian, apt install python3-venv"; exit 1; }
	@echo "installing into $(VENV) ..."
	@export PIP_DISABLE_PIP_VERSION_CHECK=1; \
	all="install --quiet --require-hashes -r requirements/all.txt"; own="install --quiet --no-deps --no-build-isolation --editable ."; \
	{ $(BIN)/python -m pip install --quiet --no-compile --require-hashes -r requirements/uv.txt && \
	  $(BIN)/uv pip $$all --python $(BIN)/python && $(BIN)/uv pip $$own --python $(BIN)/python; } 2>/dev/null || \
	{ echo "by pip, because uv could not ..."; $(BIN)/python -m pip $$all && $(BIN)/python -m pip $$own; }
	@touch $@

# Versions of constraints.txt, with everything they need and the hash of every file: after a change of pyproject.toml or constraints.txt.
lock:
	@test -x build/lock/bin/uv || { $(PYTHON) -m venv build/lock && build/lock/bin/python -m pip install --quiet uv; }
	@for what in flight all; do \
	  extras=; test $$what = flight || extras=--all-extras; \
	  echo 'setuptools>=77' | build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header \
	    --no-emit-index-url --constraints constraints.txt $$extras pyproject.toml - --output-file requirements/$$what.txt || exit 1; \
	done
	@echo uv | build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header --no-emit-index-url - --output-file requirements/uv.txt

# Whether a locked version has a known vulnerability. Fails as well if the package index has no answer for a package.
audit:
	@test -x build/audit/bin/pip-audit || { $(PYTHON) -m venv build/audit && build/audit/bin/python -m pip install --quiet pip-audit==2.10.1; }
	@for what in uv flight all; do build/audit/bin/pip-audit --strict --disable-pip --require-hashes --progress-spinner off --requirement requirements/$$what.txt || exit 1; done

fly: install
	@$(BIN)/companion fly configs/missions/catch.yaml --sitl

press: install
	@$(BIN)/companion fly configs/missions/press.yaml --sitl --world wall

intercept: install
	@$(BIN)/companion fly configs/missions/intercept.yaml --sitl --world careless

# Builds a wheel with compiled modules in build/compiled and installs it: .venv/bin/companion computes the same faster.
compile: install
	@$(BIN)/python -m tools.compiled

# Every figure of docs/internals/compare.md, flown again: make figures FLY=--plan says how long it takes, FLY="--scheduler ADDRESS" flies
# on the workers of Dask, which need examples/baselines installed.
COMPARE := $(BIN)/companion compare --world lab --first-seed 2001
SOFT := examples/compare/psc_soft.yaml,examples/compare/csc_soft.yaml
ALL_LAWS := adaptive,psc,csc,pid,indi,l1,mpc
BEST := recommended,model_free,tuned,tuned_extras,recommended_equal
ONE_LAW := --controllers adaptive --payloads 0.2
figures: export PYTHONPATH := $(CURDIR):$(CURDIR)/build/baselines
figures: install
	@rm -rf build/baselines; mkdir -p build/baselines; cp -r examples/baselines build/baselines/source
	@$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --target build/baselines build/baselines/source
	@set -e; fly() { out=$$1; shift; echo "$$out"; $(COMPARE) "$$@" --out $(FIGURES)/$$out $(FLY); }; \
	fly laws --seeds 50 --controllers $(ALL_LAWS),$(SOFT); \
	fly model_error --seeds 100 --controllers $(ALL_LAWS) --presets $(BEST) --payloads 0.2 --model-error 0.2; \
	fly adaptation --seeds 200 $(ONE_LAW) --presets recommended,model_free --adaptation on,off --model-error 0.2; \
	fly ablation --seeds 50 $(ONE_LAW) --presets recommended --ablation; \
	test "$(FLY)" = --plan || $(BIN)/python -m tools.docs.compare docs/internals/compare.md $(FIGURES)/*/compare.json

# The checks of make lint are among the tests. The same examples, checks and skips for everybody.
test: install debian
	@$(BIN)/python -m pytest -n auto --dist loadgroup

lint: install
	@$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/lint-imports --no-cache && $(BIN)/mypy

# Property tests and damaged input at every wire, at random, for whoever changes a parser: make explore MINUTES=10
explore: install
	@$(BIN)/python -m tests.explore $(MINUTES)

# Which tests cannot fail: a random sample of mutants of each package, judged by its own tests, in some minutes a package:
# make mutants MUTANTS="safety --seed 2 --count 100"
mutants: install
	@test -d build/mutants || $(BIN)/python -m pip install --quiet --disable-pip-version-check --target build/mutants cosmic-ray==8.7.0
	@$(BIN)/python -m tools.mutants $(MUTANTS)

# What tests need beside Python: a broker, a browser, udevadm. Nobody is asked for a password.
debian:
	@PATH="$$PATH:/usr/sbin:/sbin"; missing=; \
	command -v mosquitto >/dev/null || missing="$$missing mosquitto"; \
	command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || missing="$$missing chromium"; \
	command -v udevadm >/dev/null || missing="$$missing udev"; \
	test -n "$$missing" || exit 0; \
	if ! command -v apt-get >/dev/null; then as=none; elif test "$$(id -u)" = 0; then as=; elif sudo -n true 2>/dev/null; then as="sudo -n"; else as=none; fi; \
	if test "$$as" != none; then \
	  echo "installing$$missing ..."; \
	  export DEBIAN_FRONTEND=noninteractive; \
	  { $$as apt-get -qq update && $$as apt-get -qq install -y --no-install-recommends $$missing; } >/dev/null 2>&1 && exit 0; \
	fi; \
	echo "not installed:$$missing; the tests that need them are skipped (on Debian: apt install$$missing)"

# 16 minutes, ten of them a hover; one minute of it: make bench BENCH=--quick
bench: install debian
	@$(BIN)/python -m benchmarks $(BENCH)

docs: install
	@$(BIN)/mkdocs build --strict --quiet
	@echo "build/docs/index.html; with search: $(BIN)/python -m http.server --bind 127.0.0.1 --directory build/docs"

clean:
	rm -rf $(VENV) build *.egg-info
