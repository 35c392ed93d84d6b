# `make train` and `make pytest` set everything up in .venv first. Both can be repeated: what is done already is skipped.
#
#   PYTHON=python3.11   the interpreter that .venv is made from (default: the first of 3.10 to 3.12 that is found)
#   ENV=active          use the environment that is active instead of .venv, and install nothing
#   ARGS="..."          more arguments for `sb3_cpm train` (see `make train ARGS=--help`; --no-demonstrations) or for pytest: a file,
#                       -m "not slow" (a third of the time), -n 0 (everything in one process)
#   PIP_ARGS="..."      more arguments for pip, for instance where to find a CPU-only torch
#   RENDERING=system    where no Vulkan driver is found, install one for the whole machine (needs root) instead of privately;
#                       RENDERING=private: privately even where there is one
SHELL := /bin/bash
.DEFAULT_GOAL := help

VENV := .venv
SB3_TESTS := .sb3_tests
EXTRAS := run,maniskill,contrib,datasets,docs,onnx,tests,dev
CODE := sb3_cpm tests examples $(wildcard benchmarks) scripts setup.py

ifeq ($(ENV),active)
BIN :=
READY :=
PROBED :=
else
BIN := $(VENV)/bin/
READY := $(VENV)/.installed
PROBED := $(VENV)/.rendering
endif
RUN := $(BIN)python -m

# Threads that wait by spinning cost more than they bring at these sizes.
export OMP_NUM_THREADS ?= 1

# twenty episodes per evaluation tell 50% from 90%
QUICK := $(if $(filter --no-demonstrations,$(ARGS)),--agent cpm_sac_quick,--agent cpm_rlpd_quick --eval-episodes 20)

help:
	@echo "make train           set up, train on PickCube-v1 from scripted demonstrations until it succeeds, leave results in runs/"
	@echo "                     (agent cpm_rlpd_quick; ARGS=--no-demonstrations: CPM-SAC without them, agent cpm_sac_quick)"
	@echo "make pytest          set up, run all tests"
	@echo "make sb3-tests       fetch SB3's own tests, which \`make pytest\` runs with our buffer, too, where they are"
	@echo "                     (neither changes the system: RENDERING=system installs a Vulkan driver for the whole machine)"
	@echo "make doc             the documentation as a site, in site/"
	@echo "make doctor          what works here and what is missing"
	@echo "make type lint format check-codestyle commit-checks"
	@echo "make venv, make clean-venv"

train: $(READY) $(PROBED)
	$(RUN) sb3_cpm train $(QUICK) $(filter-out --no-demonstrations,$(ARGS))

# Workers share the cores; tests/conftest.py says how many: none for a single file. `-p no:xdist` takes the option away, too.
pytest: $(READY) $(PROBED)
	$(RUN) pytest $(if $(findstring no:xdist,$(ARGS)),,-n auto) $(ARGS)

# They are in SB3's source distribution only. `make pytest` runs those of the version that is installed once they are here.
sb3-tests: $(READY)
	@version="$$($(BIN)python -c 'from importlib.metadata import version; print(version("stable-baselines3"))')" && \
		if [ ! -e "$(SB3_TESTS)/stable_baselines3-$$version.tar.gz" ]; then \
			echo "==> Fetching the tests of stable-baselines3 $$version"; \
			$(RUN) pip download --quiet --disable-pip-version-check $(PIP_ARGS) --no-deps --no-binary stable-baselines3 \
				--dest "$(SB3_TESTS)" "stable-baselines3==$$version"; \
		fi

# into site/; a warning is an error
doc: $(READY)
	NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --quiet

doctor: $(READY)
	$(RUN) sb3_cpm doctor

venv: $(READY)

rendering: $(READY) $(PROBED)

$(VENV)/bin/python:
	@echo "==> Making a virtual environment in $(VENV)"
	@python="$$(scripts/find_python.sh "$(PYTHON)")" && "$$python" --version && \
		{ "$$python" -m venv $(VENV) || { rm -f $@; exit 1; }; }

$(VENV)/.installed: setup.cfg setup.py constraints.txt | $(VENV)/bin/python
	@echo "==> Installing sb3_cpm[$(EXTRAS)] with the versions of constraints.txt (about 3 minutes)"
	@# MuJoCo 4, which constraints.txt once named, leaves files of its parts in the folder of an earlier release
	@if $(BIN)python -m pip show -q mujoco-core 2>/dev/null; then \
		$(BIN)python -m pip uninstall -q -y mujoco mujoco-core mujoco-studio; fi
	@$(BIN)python -m pip install --quiet --disable-pip-version-check $(PIP_ARGS) -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

$(VENV)/.rendering: $(VENV)/.installed
	@echo "==> Looking for a Vulkan device that can render"
	@$(RUN) sb3_cpm setup-rendering $(addprefix --,$(RENDERING))
	@touch $@

type: $(READY)
	$(RUN) mypy

lint: $(READY)
	$(BIN)ruff check $(CODE)
	$(BIN)lint-imports

format: $(READY)
	$(BIN)ruff check --select I --fix $(CODE)
	$(BIN)ruff format $(CODE)

check-codestyle: $(READY)
	$(BIN)ruff check --select I $(CODE)
	$(BIN)ruff format --check --diff $(CODE)

commit-checks: format type lint

# what a release must pass beside the tests: version and changelog agree, wheel and sdist build, an index would take them
release-check: $(READY) check-codestyle lint type doc
	@version="$$(cat sb3_cpm/version.txt)"; grep -q "^## Release $$version " CHANGELOG.md || \
		{ echo "CHANGELOG.md has no section for release $$version, which sb3_cpm/version.txt names."; exit 1; }
	rm -rf dist
	$(RUN) build --outdir dist
	$(RUN) twine check --strict dist/*

clean-venv:
	rm -rf $(VENV)

.PHONY: help train pytest sb3-tests doc doctor venv rendering type lint format check-codestyle commit-checks release-check clean-venv
