# From a fresh clone, `make train` or `make test` is enough: each sets up what it needs first.
PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.setup

.PHONY: setup setup-gpu train test test-all test-gpu check bench bench-gpu gpu-campaign parity validation peers peers-setup report pictures docs

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@
	@echo 'Set up. Now: source .venv/bin/activate, then softgm-bench --help'

train: setup
	$(BIN)/python -m softgm_bench algo=softgm task=basic seed=0 experiment=quick

# One process a core, each with one thread: a test is too small to share among cores.
PYTEST := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist loadscope

test: setup
	$(PYTEST)

# Everything: the CUDA simulator, the site, the notebook, the wheel, a browser, whole reports, kill tests, sweeps, the
# whole product of algorithms, models and tasks, trainings that must learn.
test-all: setup
	$(PYTEST) -m "slow or not slow"

check: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# Speed: rod and environment steps against PyElastica, distance to the roofline, scaling; SoftGM against
# torch_geometric, the whole training loop. About fifteen minutes.
bench: setup
	$(BIN)/python benchmarks/bench_rod.py
	$(BIN)/python benchmarks/roofline.py
	$(BIN)/python benchmarks/bench_env.py
	$(BIN)/python benchmarks/bench_scaling.py
	$(BIN)/python benchmarks/bench_models.py
	$(BIN)/python benchmarks/bench_training.py

# On an NVIDIA GPU. Where PYTHON is given, as in `make test-gpu PYTHON=python3`, that interpreter is used as it is: nothing
# is installed and no network is needed.
ifneq ($(filter command environment,$(firstword $(origin PYTHON))),)
GPU_PYTHON := PYTHONPATH=src $(PYTHON)
setup-gpu:
else
GPU_PYTHON := PYTHONPATH=src $(BIN)/python
setup-gpu: setup
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[cuda]'
endif

# The tests that are marked for GPUs; skipped without one.
test-gpu: setup-gpu
	$(GPU_PYTHON) -m pytest -m gpu --durations=10 $$(grep -rl --include='test_*.py' 'pytest.mark.gpu' tests)

# What one GPU does: BENCH=--short for a minute, BENCH='--device cpu --batches 4 --short' for a rehearsal.
bench-gpu: setup-gpu
	$(GPU_PYTHON) benchmarks/bench_gpu.py $(BENCH)

# So many minutes of a GPU used whole; OUT receives at most six archives. CELLS are settings as in a sweep,
# CAMPAIGN other options; docs/gpu.md.
MINUTES ?= 10
JOBS ?= 3
gpu-campaign: setup-gpu
	$(if $(OUT),,$(error give OUT, the folder of the archives))
	$(GPU_PYTHON) experiments/gpu_campaign.py --minutes $(MINUTES) --out $(OUT) --jobs $(JOBS) \
		$(if $(GRID),--grid $(GRID)) $(if $(DONE),--done $(DONE)) $(CAMPAIGN) -- $(CELLS)

# Trust: every case of the parity suite as a table; solutions in closed form, energy, order in time, float32.
parity: setup
	$(BIN)/python benchmarks/parity.py

validation: setup
	$(BIN)/python benchmarks/validation.py

# The example report, of the campaign: its finished cells and their evaluations.
report: setup
	$(BIN)/python -m softgm_bench.report experiments/campaign out=experiments/report

# The site, in build/site; warnings are errors. Read it with: python -m http.server -d build/site
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# The pictures of docs/pictures, from the policies in experiments/policies.
pictures: setup
	$(BIN)/python experiments/pictures.py

# Our algorithms and BenchMARL's on two VMAS tasks. BenchMARL needs an older TorchRL, so it has a virtual environment of
# its own. Runs of which the results are there already are left out; all of them take two hours on a core.
PEERS := benchmarks/peers
PEERS_STAMP := $(PEERS)/.venv/.setup
THREADS ?= 1

peers-setup: $(PEERS_STAMP)

$(PEERS_STAMP): $(PEERS)/requirements.txt
	test -x $(PEERS)/.venv/bin/python || $(PYTHON) -m venv $(PEERS)/.venv
	$(PEERS)/.venv/bin/python -m pip install --quiet -r $(PEERS)/requirements.txt
	touch $@

peers: setup peers-setup
	$(BIN)/python $(PEERS)/run_all.py --threads $(THREADS)
	$(BIN)/python $(PEERS)/report.py
