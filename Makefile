# The two commands of README: `make up` and `make test`. Everything else here is a step of one of them.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SKIN ?= square16
# What else `make venv` installs the packages of: bridges, EXTRAS=ros2,foxglove, and `docs`, which `make site` needs
EXTRAS ?=
comma := ,
WANTED := $(subst $(comma), ,$(EXTRAS))
# The CPU build of PyTorch by its full version: plain "torch" would bring several GB of CUDA.
TORCH := torch==2.13.0+cpu
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: up venv venv-dev ros-venv test test-all golden lint site train lock clean

up: venv
	./skin up

venv: $(VENV)/.service $(WANTED:%=$(VENV)/.%)
venv-dev: $(VENV)/.dev

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "found Python %s; eitskin needs 3.11 or newer: make PYTHON=python3.11 ..." % sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.service: requirements/service.lock | $(BIN)/python
	$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r $<
	@touch $@

$(VENV)/.ros2 $(VENV)/.foxglove $(VENV)/.docs: $(VENV)/.%: requirements/%.lock | $(VENV)/.service
	$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r $<
	@touch $@

$(VENV)/.dev: requirements/dev.lock requirements/service.lock | $(BIN)/python
	$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r $<
	$(BIN)/python -m pip install -q --disable-pip-version-check "$(TORCH)" || { echo \
	  "no wheel of $(TORCH) found: install PyTorch's CPU build 2.13.0 into $(VENV) as pytorch.org describes, then run make again"; exit 1; }
	@touch $@ $(VENV)/.service

# ROS 2 itself, as wheels, in an environment of its own: what tests/bridges/test_ros2_node.py listens with. 270 MB.
ROS ?= kilted
ROS_VENV := .venv-ros$(if $(filter-out kilted,$(ROS)),-$(ROS))
ROS_PACKAGES := rclpy rmw-fastrtps-cpp geometry-msgs sensor-msgs diagnostic-msgs visualization-msgs std-msgs std-srvs
ros-venv: $(ROS_VENV)/.done
$(ROS_VENV)/.done:
	$(PYTHON) -m venv $(ROS_VENV)
	$(ROS_VENV)/bin/python -m pip install -q --disable-pip-version-check numpy $(ROS_PACKAGES:%=ros-$(ROS)-%)
	@touch $@

# Five minutes on two cores once all is installed. What is slow by nature is in test-all, which CI runs.
test: venv-dev lint
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-all: venv-dev lint
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "slow or not slow"

# What recordings of tests/ give now is what they are to give from now on; git diff shows what changed.
golden: venv-dev
	./skin golden tests/recording/golden/*.mcap --accept

lint: venv-dev
	$(BIN)/ruff check .
	$(BIN)/mypy protocol services bridges examples firmware_stub models bench

# The documents as a site in build/site; a warning is an error. NO_MKDOCS_2_WARNING: advice of the theme's, not of ours.
site: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -q

# geometry -> forward model -> data -> network -> bundle in models/bundles/$(SKIN)
train: venv-dev
	$(BIN)/python -m models.build --skin $(SKIN) $(if $(filter-out 0,$(QUICK)),--quick) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(filter-out 0,$(ANYWAY)),--anyway)

# Needs uv (one lock for every Python from 3.11 on, hashes of every file).
LOCK := uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-emit-index-url
lock:
	$(LOCK) --extra service --extra stub -o requirements/service.lock pyproject.toml
	for extra in ros2 foxglove docs; do \
	  $(LOCK) -c requirements/service.lock --extra $$extra -o requirements/$$extra.lock pyproject.toml || exit 1; done
	$(LOCK) -c requirements/service.lock --extra service --extra stub --extra offline --extra ros2 --extra foxglove --extra dev \
	  -o requirements/dev.lock pyproject.toml requirements/torch-needs.in

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
