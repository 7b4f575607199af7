# Two commands: `make demo` reconstructs a scene the project makes itself, `make test` runs the
# tests. Both set up what they need: a virtual environment in .venv and the compiled extension.

PYTHON ?= python3
CORES ?= all
VENV := .venv
BIN := $(VENV)/bin

READERS := tests/io/independent

.PHONY: demo test test-fast test-native test-slurm test-packages lint format docs site viewer lock setup extension clean
.DEFAULT_GOAL := help

help:
	@echo "make demo   reconstruct the demo scene into results/demo (sets everything up first)"
	@echo "make test   run the tests;  make test-fast  those without Snakemake and training"
	@echo "make test-native  the tests of the C++ code alone"
	@echo "make test-slurm  those of faults on a Slurm cluster (root; Debian's slurm-wlm and munge)"
	@echo "make test-packages  other projects' packages that some tests compare with (needs Node)"
	@echo "make setup  only set up .venv and the extension"
	@echo "make lint   what CI checks beside the tests;  make format  repairs most of it"
	@echo "make docs   regenerate the generated pages of docs/ and config/config.yaml"
	@echo "make site   build the docs as a site in build/site; broken links are errors"
	@echo "make lock   write requirements/ from the ranges in pyproject.toml (needs uv)"
	@echo "make viewer rebuild the pages' viewer (needs Node 20 or newer)"
	@echo "make clean  remove results/ and data/demo"

# pip would compile every module to bytecode, which takes longer than the rest of the installation;
# Python compiles those that are imported, unless this variable forbids it.
export PYTHONDONTWRITEBYTECODE :=
PIP_INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile

# `make TORCH=cpu ...` takes the build for processors: on Linux, the one of the package index brings
# gigabytes of CUDA, which nothing here uses.
TORCH ?=
TORCH_FROM := $(if $(filter cpu,$(TORCH)),--index-url https://download.pytorch.org/whl/cpu)

# A stamp file each: the program's own packages, and those of its extras. requirements/ has exact
# versions with digests, of all packages but torch: its builds differ by machine.
EXTRAS := watch gpu usd dev test docs slurm
$(VENV)/product: requirements/product.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: Python 3.11 or newer is needed, $$($(PYTHON) --version) found; set PYTHON=..."; exit 2; }
	@command -v $${CXX:-g++} >/dev/null || { test -z "$$CXX" && command -v clang++ >/dev/null; } || \
	  { echo "error: no C++ compiler found ($${CXX:-g++, clang++}); install g++, or set CXX"; exit 2; }
	@test -x $(BIN)/pip || $(PYTHON) -m venv --clear $(VENV) || \
	  { echo "error: no virtual environment could be made; on Debian and Ubuntu install python3-venv"; exit 2; }
	@echo "installing dependencies into $(VENV) (once; about a minute)"
	@$(PIP_INSTALL) $(TORCH_FROM) $$(sed -n 's/^ *"\(torch==[0-9.]*\)",$$/\1/p' pyproject.toml)
	@$(PIP_INSTALL) -r requirements/$(@F).txt
	@touch $@

$(addprefix $(VENV)/,$(EXTRAS)): $(VENV)/%: requirements/%.txt $(VENV)/product
	@echo "installing the packages of '$(@F)' into $(VENV)"
	@$(PIP_INSTALL) -r requirements/$(@F).txt
	@touch $@

# The command `splatmake` of this checkout. It finds the checkout from its own place, so that it runs
# in any folder.
$(BIN)/splatmake: | $(VENV)/product
	@printf '%s\n' '#!/bin/sh' 'bin=$$(dirname "$$(readlink -f "$$0")")' \
	  'PYTHONPATH=$$bin/../..$${PYTHONPATH:+:$$PYTHONPATH} exec "$$bin/python" -P -m pipeline "$$@"' > $@
	@chmod +x $@

extension: $(VENV)/product $(BIN)/splatmake
	@$(BIN)/python -m pipeline.render.cpu.build
	@$(BIN)/python -m pipeline.sfm.nearest
	@$(BIN)/python -m pipeline.mvs.patchmatch

setup: extension $(VENV)/watch

data/demo/demo.json: | extension
	@$(BIN)/python -m pipeline.demo data/demo

# Fewer steps than the preset's: the demo is small, and shall be there within minutes.
demo: extension data/demo/demo.json
	@$(BIN)/snakemake --cores $(CORES) results/demo/metrics.json --config 'train={"steps": 1500}'

# More than two cores' worth: tests that run Snakemake start many programs, one after the other.
WORKERS := 3

# These start a Slurm cluster on this machine, of which there is one at a time.
SLURM_TESTS := tests/cluster

test: setup $(VENV)/dev $(VENV)/gpu
	@$(BIN)/python -m pytest tests --ignore=$(SLURM_TESTS) -n $(WORKERS) --dist worksteal

# Half of the tests in a tenth of the time, for each change: no scene is reconstructed, no kernel is
# compared with its reference, nothing is fuzzed.
FAST_TESTS := $(addprefix tests/,api config geometry io plan runtime scene splats metrics photos reporting \
  command training/density training/losses training/optimisers test_layers.py test_schemas.py \
  test_reference_pages.py test_tools.py) --ignore=tests/io/clouds --ignore=tests/reporting/test_viewer.py \
  --ignore=tests/reporting/test_barriers.py
test-fast: setup $(VENV)/dev
	@$(BIN)/python -m pytest $(FAST_TESTS) -m "not slow" -n $(WORKERS) --dist worksteal

test-slurm: setup $(VENV)/dev $(VENV)/slurm
	@$(BIN)/python -m pytest $(SLURM_TESTS)

# What a C++ compiler can change, which the kernels of a GPU are not; CXX chooses it.
NATIVE_TESTS := tests/render tests/sfm/test_matching.py tests/training
test-native: setup $(VENV)/dev
	@$(BIN)/python -m pytest $(NATIVE_TESTS) -k "not gpu and not device and not resident" -n $(WORKERS) --dist worksteal

# Other projects' readers and decoders: without them, the tests that compare with them are skipped.
test-packages: $(VENV)/test $(VENV)/usd $(READERS)/node_modules/.package-lock.json

$(READERS)/node_modules/.package-lock.json: $(READERS)/package-lock.json
	@echo "installing Node's packages into $(READERS)"
	@cd $(READERS) && npm ci --no-audit --no-fund --loglevel=error
	@touch $@

lint: $(VENV)/dev
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/snakefmt --check Snakefile
	@$(BIN)/clang-format --dry-run --Werror $$(git ls-files 'pipeline/*/csrc/*')
	@$(BIN)/codespell
	@$(BIN)/python -m tests.rooms --check
	@$(BIN)/python -m tests.size --check

format: $(VENV)/dev
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format . ; $(BIN)/snakefmt Snakefile
	@$(BIN)/clang-format -i $$(git ls-files 'pipeline/*/csrc/*')

docs: $(VENV)/product
	@$(BIN)/python -m pipeline.config.docs
	@$(BIN)/python -m pipeline.command.reference_pages
	@$(BIN)/python -m benchmarks.tables
	@$(BIN)/python -m tests.rooms

site: $(VENV)/docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# Needs uv. Versions stay where the ranges of pyproject.toml allow it; UPGRADE=1 takes the newest.
# Without torch and what torch alone needs; the extras without the program's own packages.
LOCK := uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes --quiet \
  --override requirements/no-torch.txt --no-header --no-annotate $(if $(UPGRADE),--upgrade)
OWN = $$(sed -n 's/^\([^ ]*\)==.*/--no-emit-package \1/p' requirements/product.txt)
lock:
	@$(LOCK) -o requirements/product.txt
	@$(foreach extra,$(EXTRAS),$(LOCK) --extra $(extra) -c requirements/product.txt $(OWN) \
	  -o requirements/$(extra).txt;)

VIEWER := pipeline/reporting/viewer
viewer:
	@mkdir -p build/viewer
	@rm -rf build/viewer/src
	@cp -r $(VIEWER)/package.json $(VIEWER)/package-lock.json $(VIEWER)/src build/viewer
	@cd build/viewer && npm ci --ignore-scripts && npm run build
	@cp build/viewer/viewer.min.js $(VIEWER)

clean:
	rm -rf results data/demo
