# SPDX-License-Identifier: Apache-2.0
# make demo | test | bench | docs | soak | lint | test-floor: each does all the set-up that it needs.
# A step's stamp is written only after the step succeeded; an interrupted one is simply done again.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

# A ROS or a venv that is active in the calling shell must not mix with this one.
unexport PYTHONPATH PYTHONHOME VIRTUAL_ENV AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
unexport LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
# What is compiled of the tests is kept: to do it anew takes each worker seconds.
unexport PYTHONDONTWRITEBYTECODE
export PIP_DISABLE_PIP_VERSION_CHECK := 1

VENV := .venv
STAMPS := $(VENV)/.stamps
LOCKED := --constraint requirements/constraints.txt
ROS := tools/with_ros

# A venv holds absolute paths: one that was moved or copied here is made anew (not by `make -n`).
ifneq ($(if $(findstring n,$(firstword -$(MAKEFLAGS))),,$(wildcard $(STAMPS))),)
ifeq ($(shell grep -sF -- '$(CURDIR)/$(VENV)' $(VENV)/pyvenv.cfg),)
$(shell rm -rf $(VENV) $(VENV)-* build install log)
endif
endif

.PHONY: help demo test bench figures docs soak lint test-floor setup setup-dev clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' Makefile | sed -E 's/:[^#]*##/\t/' | expand -t 14

demo: setup  ## a simulated cell in closed loop through the live nodes, report in out/report/
	$(HURRIES) $(ROS) python bags/demo.py

# Live cells of up to seven processes, and motions that are judged by time, come first, one at a time, for
# on a slow computer one needs both cores; then the other node tests, six at a time. They mostly wait,
# and what all others compute fills their pauses: where the user may, node tests go before whatever else
# runs on the machine, elsewhere the others stand back a little, but get on beside what is busy for
# long. What failed is shown last. A
# node test that failed is run once again, twice where time judges, as others on the machine may have
# starved it, and named; never one whose examples chance picks, nor one whose output jumped
# (test/worlds/jumps.py says when it may). So is one that Fast DDS took along as it crashed: each runs
# in a process of xdist's.
HURRIES := $(shell [ "$$(nice -n -10 nice 2>/dev/null)" -lt 0 ] && echo nice -n -10)
GIVES_WAY := $(if $(HURRIES),,nice -n 5)
PYTEST := $(ROS) python -m pytest -p no:cacheprovider
AGAIN := --rerun-except '^JumpError: ' -rfER
test: setup-dev  ## the tests, their long forms left out; TESTS="test/tool -k laser" for some
	@if [[ -n "$(TESTS)" ]]; then exec $(ROS) python -m pytest $(TESTS); fi
	mkdir -p out
	failed=0
	$(GIVES_WAY) $(PYTEST) -n 2 --dist worksteal --ignore=test/nodes >out/test_others.txt 2>&1 & others=$$!
	trap 'kill $$others 2>/dev/null || true' EXIT
	live() {  # what, how many at a time, how often again, which, where
		$(HURRIES) $(PYTEST) --reruns $$3 $(AGAIN) -n $$2 --dist worksteal -m "$$4" $${@:5} 2>&1 | tee out/test_$$1.txt || failed=1
	}
	live cells 1 2 cell $$(grep -l 'pytest\.mark\.cell' test/nodes/test_*.py)  # the others need not be read
	live nodes 6 1 "not cell" test/nodes
	wait $$others || failed=1
	echo "== tests beside those of the nodes"
	cat out/test_others.txt
	[[ $$failed -eq 0 ]] || sed -sn '/ test summary info/,$$p' out/test_{cells,nodes}.txt
	exit $$failed

bench: setup $(VENV)-bench/.stamp  ## accuracy on real measurements, speed beside other libraries
	$(ROS) $(VENV)-bench/bin/python -m bench

figures: setup $(VENV)-bench/.stamp  ## bench, kept as the figures of docs/
	$(ROS) $(VENV)-bench/bin/python -m bench --keep

docs: setup $(VENV)-docs/.stamp  ## the pages as a site in out/site, with a reference; links checked
	$(ROS) python tools/site_pages.py out/docs
	NO_MKDOCS_2_WARNING=1 $(VENV)-docs/bin/mkdocs build --strict --quiet
	@echo out/site/index.html

soak: setup-dev  ## hours: kills, random work, a live graph under load, more simulated robots
	$(ROS) python -m bench.soak $(SOAK)

lint: setup-python $(STAMPS)/dev  ## style and strict types
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

test-floor: $(VENV)-floor/.stamp  ## tests that need no ROS, with the versions of Ubuntu 24.04
	OPENBLAS_NUM_THREADS=1 NUMBA_CACHE_DIR=$(CURDIR)/$(VENV)-floor/kernels \
		$(VENV)-floor/bin/python -m pytest -m "not ros" $(TESTS)

setup: setup-python setup-ros $(STAMPS)/kernels  ## everything that the demo needs

setup-dev: setup $(STAMPS)/dev  ## that, and what tests and lint need

clean:  ## remove everything that make made
	rm -rf $(VENV) $(VENV)-* build install log out
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

# ---- Python: the wheels, their mended CMake files, this package ---------------------------------
.PHONY: setup-python
setup-python: $(STAMPS)/editable

PYTHON_FILES := setup.py setup.cfg pyproject.toml package.xml

NEEDED := -r requirements/ros.txt -r requirements/core.txt -r requirements/line.txt
$(STAMPS)/wheels: requirements/ros.txt requirements/core.txt requirements/line.txt \
		requirements/constraints.txt tools/mend_wheels.py
	@echo "Installing ROS 2 Jazzy and the other wheels into $(VENV) (about a minute, once)"
	tools/make_venv $(VENV) "3.11 3.12" $(LOCKED) $(NEEDED)
	$(VENV)/bin/python tools/mend_wheels.py
	mkdir -p $(STAMPS)
	touch $@

# The venv of an install that was cut off is emptied, with the stamps of all that it held.
$(STAMPS)/dev: $(STAMPS)/wheels requirements/dev.txt
	@echo "Installing what tests and lint need (once)"
	tools/make_venv $(VENV) "3.11 3.12" $(LOCKED) $(NEEDED) -r requirements/dev.txt
	[ -e $< ] || { echo "make: an install that was cut off was begun anew; run make again" >&2; exit 1; }
	touch $@

$(STAMPS)/editable: $(STAMPS)/wheels $(PYTHON_FILES)
	@$(VENV)/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# Compiled kernels are kept beside their source; nodes start 1.5 s sooner with them.
$(STAMPS)/kernels: $(STAMPS)/editable \
		$(shell grep -rls --include='*.py' 'robocal_ros.ground.compiled import' robocal_ros) robocal_ros/cli/warm.py
	@$(VENV)/bin/python -m robocal_ros.cli.main warm
	touch $@

# ---- ROS: the two packages in install/ ---------------------------------------------------------
.PHONY: setup-ros
setup-ros: $(STAMPS)/robocal_ros

COLCON = PATH="$(CURDIR)/$(VENV)/bin:$$PATH" AMENT_PREFIX_PATH="$(CURDIR)/$(VENV)" \
	CMAKE_PREFIX_PATH="$(CURDIR)/$(VENV)" \
	colcon --log-base log build --symlink-install --base-paths . msg_defs tools/interfaces \
	--event-handlers console_cohesion- --packages-select

# Build folders remember absolute paths and half-done work: these start afresh.
INTERFACES := robocal_msgs control_msgs tf2_msgs
$(STAMPS)/interfaces: $(STAMPS)/wheels $(shell find msg_defs tools/interfaces -type f)
	@echo "Building $(INTERFACES) (about half a minute, once)"
	command -v c++ >/dev/null || { echo "make: a C++ compiler is needed (apt install g++)" >&2; exit 1; }
	rm -rf $(INTERFACES:%=build/%) $(INTERFACES:%=install/%)
	$(COLCON) $(INTERFACES) --cmake-args -GNinja -DBUILD_TESTING=OFF \
		-DCMAKE_PROJECT_TOP_LEVEL_INCLUDES="$(CURDIR)/tools/python_only.cmake"
	touch $@

# Python sources are linked, not copied: only new entry points, config and launch files need this again.
$(STAMPS)/robocal_ros: $(STAMPS)/interfaces $(PYTHON_FILES) $(shell find config launch resource)
	@rm -rf build/robocal_ros install/robocal_ros
	$(COLCON) robocal_ros
	touch $@

# ---- Other venvs -------------------------------------------------------------------------------
$(VENV)-bench/.stamp: requirements/bench.txt requirements/core.txt requirements/constraints.txt
	@echo "Installing the libraries to compare with into $(VENV)-bench (once)"
	tools/make_venv $(VENV)-bench "3.11 3.12" $(LOCKED) -r requirements/core.txt -r requirements/bench.txt
	touch $@

$(VENV)-docs/.stamp: requirements/docs.txt
	@echo "Installing what makes the site into $(VENV)-docs (once)"
	tools/make_venv $(VENV)-docs "3.11 3.12" -r requirements/docs.txt
	touch $@

$(VENV)-floor/.stamp: requirements/floor.txt
	@echo "Installing the versions of Ubuntu 24.04 into $(VENV)-floor (once)"
	tools/make_venv $(VENV)-floor "3.12 3.11" -r requirements/floor.txt
	touch $@
