# From a fresh clone, `make train` or `make test` is enough: each sets up what it needs first.
PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.setup

.PHONY: setup train test test-slow check bench bench-gpu parity validation

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

train: setup
	$(BIN)/python -m softgm_bench algo=softgm task=basic seed=0 recipe=open experiment=quick

test: setup
	$(BIN)/python -m pytest

test-slow: setup
	$(BIN)/python -m pytest -m slow

check: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# Speed: rod and environment steps against PyElastica, distance to the roofline, scaling; SoftGM against
# torch_geometric. About seven minutes.
bench: setup
	$(BIN)/python benchmarks/bench_rod.py
	$(BIN)/python benchmarks/roofline.py
	$(BIN)/python benchmarks/bench_env.py
	$(BIN)/python benchmarks/bench_scaling.py
	$(BIN)/python benchmarks/bench_models.py

# The same on an NVIDIA GPU.
bench-gpu: setup
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[cuda]'
	$(BIN)/python benchmarks/bench_gpu.py

# Trust: every case of the parity suite as a table; solutions in closed form, energy, order in time, float32.
parity: setup
	$(BIN)/python benchmarks/parity.py

validation: setup
	$(BIN)/python benchmarks/validation.py
