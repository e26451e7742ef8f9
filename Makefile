# make setup   .venv with ROS 2, training and test tools, and this package in it (edits to the source take effect at once)
# make test    lint, types, tests
# make demo    the live node on a bag of a synthetic hand; look into demo_output/
#
# Needs Python >= 3.10, a C++ compiler and make. `make PYTHON=python3.12` picks an interpreter.

PYTHON ?= python3
VENV   := .venv
STAMP  := $(VENV)/.setup-done

# The release of torch that the results were made with. It is the only pin: everything else may move on.
TORCH  := torch==2.13.0

.PHONY: setup test demo

setup: $(STAMP)

# Messages are compiled and entry points are written at installation; anything else may change without it.
$(STAMP): Makefile pyproject.toml setup.py CMakeLists.txt package.xml $(wildcard msg/*.msg scripts/*)
	@$(PYTHON) -c 'import sys, venv; sys.exit(None if sys.version_info >= (3, 10) else "Python >= 3.10 is needed: make PYTHON=...")'
	@command -v c++ > /dev/null || { echo 'A C++ compiler is needed to build the messages (Debian, Ubuntu: apt install g++).'; exit 1; }
	$(VENV)/bin/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	@echo 'Installing into $(VENV): 3 GB (6 with CUDA) and some minutes, once ...'
	$(VENV)/bin/python -m pip install --quiet '$(TORCH)' --editable '.[ros,messages,train,docs,test]'
	$(VENV)/bin/python -c 'import hand_pose_ros.msg'
	@touch $@

test: setup
	$(VENV)/bin/ruff check
	$(VENV)/bin/mypy
	OMP_NUM_THREADS=1 $(VENV)/bin/pytest --numprocesses 2 --dist worksteal

demo: setup
	$(VENV)/bin/hand-pose demo --out demo_output
