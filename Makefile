# The two commands of README: `make up` and `make test`. Everything else here is a step of one of them.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SKIN ?= square16
# What else `make venv`, `make venv-dev` and `make test` install, as in EXTRAS=ros2,train: the extras of pyproject.toml.
#   foxglove, ros2   what that bridge, export needs  offline   making a skin from a drawing or from presses
#   plots            matplotlib: pictures         train     the same, plots and PyTorch: several GB from PyPI
#   peers            the same but PyTorch, and the other programs that benchmarks compare with
#   docs             `make site`, which asks for it itself   hdf5   rows in HDF5, MATLAB's v7.3
EXTRAS ?=
comma := ,
WANTED := $(subst $(comma), ,$(EXTRAS))
TORCH := $(shell grep -o 'torch==[0-9.]*' pyproject.toml)

.PHONY: up venv venv-dev ros-venv test check-all search golden lint site train lock clean

up: venv
	./skin up

venv: $(VENV)/.service $(WANTED:%=$(VENV)/.%)
venv-dev: $(VENV)/.dev $(WANTED:%=$(VENV)/.%)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "found Python %s; eitskin needs 3.11 or newer: make PYTHON=python3.11 ..." % sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)

# Every lock names the files' hashes. Sizes: `du -sh .venv` after each, Linux x86_64, Python 3.11.
PIP := $(BIN)/python -m pip install --disable-pip-version-check
LOCKED := $(PIP) --require-hashes -r

$(VENV)/.service: requirements/service.lock | $(BIN)/python
	@echo "installing what the service needs into $(VENV): 120 MB to fetch, 400 MB on disk, 1 to 5 minutes"
	$(LOCKED) $<
	@touch $@

$(VENV)/.ros2 $(VENV)/.foxglove $(VENV)/.hdf5 $(VENV)/.docs $(VENV)/.offline $(VENV)/.plots $(VENV)/.peers: \
    $(VENV)/.%: requirements/%.lock | $(VENV)/.service
	@echo "installing the extra $*"
	$(LOCKED) $<
	@touch $@

$(VENV)/.train: requirements/train.lock | $(VENV)/.service
	@echo "installing the extra train: with PyTorch. PyPI's brings CUDA: several GB to fetch. Where that is too much, install its"
	@echo "CPU build of the same version into $(VENV) first, as pytorch.org describes: it is taken then"
	$(LOCKED) $<
	$(PIP) "$(TORCH)"
	@touch $@

$(VENV)/.dev: requirements/dev.lock | $(BIN)/python
	@echo "installing what tests need into $(VENV), the service's packages too: 300 MB to fetch, 850 MB on disk, 2 to 8 minutes"
	$(LOCKED) $<
	@touch $@ $(VENV)/.service

# ROS 2 without a ROS installation: PyPI's wheels of it, and bridges/ros2 built with them by colcon, all in an environment
# of its own. From Debian: g++, make, and Python's headers where Python is Debian's (python3-dev). 400 MB, one to three minutes.
ROS ?= kilted
ROS_VENV := $(CURDIR)/.venv-ros$(if $(filter-out kilted,$(ROS)),-$(ROS))
ROS_PACKAGES := rclpy rmw-fastrtps-cpp std-msgs geometry-msgs sensor-msgs diagnostic-msgs visualization-msgs std-srvs \
  ament-cmake rosidl-default-generators rosidl-default-runtime
# What these do not say that they need
ROS_PACKAGES += ament-package ament-cmake-include-directories rosidl-core-generators rosidl-generator-py \
  $(if $(filter jazzy,$(ROS)),ament-cmake-ros ament-cmake-gmock ament-cmake-gtest ament-cmake-pytest \
  python-cmake-module fastrtps-cmake-module,ament-cmake-ros-core)
COLCON := "setuptools<80" catkin-pkg $(patsubst %,colcon-%,core ros cmake recursive-crawl library-path)
ros-venv: $(ROS_VENV)/.done
$(ROS_VENV)/.wheels: Makefile
	$(PYTHON) -m venv $(ROS_VENV)
	$(ROS_VENV)/bin/python -m pip install --disable-pip-version-check -q numpy $(COLCON) $(if $(shell command -v cmake),,cmake) \
	  $(ROS_PACKAGES:%=ros-$(ROS)-%)
	@touch $@
# The headers of Python and numpy are where the wheels' build machine had them, in their cmake files: here they are.
$(ROS_VENV)/.done: $(ROS_VENV)/.wheels $(shell find bridges/ros2 protocol tests/bridges/tf2_msgs -type f -not -name '*.pyc')
	cd $(ROS_VENV) && include=$$(bin/python -c 'import sysconfig; print(sysconfig.get_path("include"))') && \
	  numpy=$$(bin/python -c 'import numpy; print(numpy.get_include())') && \
	  { grep -rlE '/opt/(_internal|python)/' share --include='*.cmake' || true; } | xargs -r sed -i -E \
	  "s#/opt/(_internal|python)/[^\";]*/numpy/[^\";]*include#$$numpy#g; s#/opt/(_internal|python)/[^\";]*/include/python3[.0-9]+#$$include#g"
	$(ROS_VENV)/bin/python -m pip install --disable-pip-version-check -q .
	env -u _ROS_WHEELS_BOOTSTRAP_COMPLETE -u PYTHONPATH -u LD_LIBRARY_PATH PATH="$(ROS_VENV)/bin:$$PATH" \
	  AMENT_PREFIX_PATH=$(ROS_VENV) CMAKE_PREFIX_PATH=$(ROS_VENV) colcon --log-base build/ros-$(ROS)/log build --merge-install \
	  --executor sequential --base-paths bridges/ros2 tests/bridges/tf2_msgs --build-base build/ros-$(ROS) \
	  --install-base $(ROS_VENV) --cmake-args -DPython3_EXECUTABLE=$(ROS_VENV)/bin/python
	@touch $@

# First what is deterministic, on all cores, then what is live (processes, sockets, the real clock), one at a time. Only a
# live test is run again where it fails, and the last lines say so. What is slow or needs more is in check-all.
test: venv-dev lint
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not live and not release"
	$(BIN)/python -m pytest -n 1 --reruns 2 --reruns-delay 1 -rR -m "live and not release"

# All the rest, whatever fails on the way; ends with a table, which build/check-all.json keeps.
check-all:
	$(PYTHON) .ci/check_all.py $(ONLY)

# Goes on searching where tests try the same inputs every time: random examples, and each decoder for a minute.
search: venv-dev
	EITSKIN_SEARCH=1 $(BIN)/python -m pytest -n auto -m "release or not release" $$(grep -rlE --include="test_*.py" "from hypothesis|EITSKIN_SEARCH" tests)
	$(BIN)/python tests/fuzz/run.py --seconds 60

# What recordings of tests/ give now is what they are to give from now on; git diff shows what changed.
golden: venv-dev
	./skin golden tests/recording/golden/*.mcap --accept

# Without the extra train mypy takes what PyTorch gives as Any, and cannot be strict about what is made of it; check-all can.
WITHOUT_TORCH := --allow-subclassing-any --allow-untyped-decorators --no-warn-return-any --no-warn-unused-ignores
lint: venv-dev
	$(BIN)/ruff check .
	$(BIN)/complexipy --plain
	$(BIN)/mypy protocol services bridges examples firmware_stub models bench simulation \
	  $$($(BIN)/python -c 'import importlib.util as u; u.find_spec("torch") or print("$(WITHOUT_TORCH)")')

# The documents as a site in build/site; a warning is an error. NO_MKDOCS_2_WARNING: advice of the theme's, not of ours.
site: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -q

# geometry -> forward model -> data -> network -> bundle in models/bundles/$(SKIN)
train: venv $(VENV)/.train
	$(BIN)/python -m models.build --skin $(SKIN) $(if $(filter-out 0,$(QUICK)),--quick) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(filter-out 0,$(ANYWAY)),--anyway)

# Needs uv (one lock for every Python from 3.11 on, hashes of every file). Each agrees with those before it, since all may
# meet in one environment.
LOCK := uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-emit-index-url
lock:
	made=; \
	lock() { $(LOCK) $$made -o requirements/$$1.lock pyproject.toml "$${@:2}" && made="$$made -c requirements/$$1.lock"; }; \
	set -e; \
	lock service --extra service --extra stub; \
	lock dev --extra service --extra stub --extra offline --extra ros2 --extra foxglove --extra dev; \
	for extra in offline plots peers ros2 foxglove hdf5 docs; do lock $$extra --extra $$extra; done; \
	lock train --extra offline --extra plots requirements/torch-needs.in

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .complexipy_cache .pytest_cache
