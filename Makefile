# make demo    the main job on a rendered clip, from nothing: needs python3 (3.10 to 3.13) only
# make test    the tests
# make lint    ruff and mypy, as CI runs them
# make slow    the tests marked slow
# make bench   the benchmarks (ARGS="..." goes to them)
# make cuda-check  the CUDA kernels for all architectures: needs nvcc, no GPU
# make clean   remove .venv and caches; runs/ stays
#
# The first use sets up .venv; later ones re-use it until pyproject.toml or constraints.txt changes.
# PYTHON=/path/to/python3.12 chooses the interpreter. ARGS="..." adds arguments to any command.

export PYTHON
ARGS ?=
BIN := .venv/bin
# A test has one thread (tests/conftest.py), so that cores can share them out; ARGS="-n 0" for one.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal

.DEFAULT_GOAL := help
.PHONY: help setup demo test slow lint bench cuda-check clean

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

setup:
	@.ci/setup dev

demo:
	@.ci/setup run
	@$(BIN)/droidw demo $(ARGS)

test:
	@.ci/setup test
	@$(PYTEST) $(ARGS)

slow:
	@.ci/setup test
	@$(BIN)/python -m pytest --runslow -m slow $(ARGS)

lint:
	@.ci/setup dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench:
	@.ci/setup test
	@$(BIN)/python benchmarks/end_to_end.py $(ARGS)

cuda-check:
	@.ci/cuda-check $(ARGS)

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache build dist *.egg-info
