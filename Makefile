# One command from a fresh clone: `make demo` trains and shows a model, `make test` tests the library
# and the commands, `make test-dataset` the generator of scenes.
# Both create .venv first, and may be repeated. `make dataset-env` installs Blender, which
# `python -m experiments.dataset.make` renders with, beside it. `make benchmark-small` needs both: it
# renders eight scenes and compares three methods on them; docs/benchmark.md says how long that takes.
# `make faults` kills and disturbs commands, and compares what they come to (docs/reliability.md).
# `make paper-table` adds all rows of the paper's main table that there are, which takes hours.
# `make notebooks` executes those of experiments/colab and stores them with what they print and draw.

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

VENV := .venv
READY := $(VENV)/.ready
BLENDER_VENV := .venv-dataset
BLENDER_READY := $(BLENDER_VENV)/.ready
RUN := $(VENV)/bin/python -m

# Two scenes of each category and each background, and two with opaque contents: 50 training views
# of 100 x 100 and 8 test views.
SMALL := runs/benchmark-small
SMALL_SCENES := cube_smcvx_cylinder,env_smcvx_pyramid,cube_smncvx_torus,sphere_smncvx_teapot
SMALL_SCENES := $(SMALL_SCENES),sphere_mmncvx_conical_flask,env_mmncvx_perfume_red
SMALL_SCENES := $(SMALL_SCENES),cube_mmncvx_flower_vase,sphere_smncvx_light_bulb

# As many processes as cores, at most 5: each one imports all tests, which takes 20 s.
PROCESSES = $(shell $(PYTHON) -c 'import os; print(min(5, os.cpu_count() or 1))')
PYTEST = $(RUN) pytest --numprocesses=$(PROCESSES) --dist=loadscope --no-loadscope-reorder
DATASET_TESTS := tests/experiments/dataset

.PHONY: demo test test-dataset test-accelerator test-slow lint format clean notebooks dataset-env \
	benchmark-small faults paper-table

demo: $(READY)
	$(RUN) experiments.train --scene=experiments/data/cube_smcvx_ball --out=runs/demo --resume
	$(RUN) experiments.evaluate --run=runs/demo --split=test --rays_per_pixel=4 --overwrite
	@echo "Look at runs/demo/eval/test/comparison.png"

test: $(READY)
	$(PYTEST) --ignore=$(DATASET_TESTS)

test-dataset: $(READY)
	$(PYTEST) $(DATASET_TESTS)

# What `accelerator_check` reports where there is none; a minute.
test-accelerator: $(READY)
	$(RUN) pytest -m slow tests/experiments/test_accelerator_check.py

test-slow: $(READY)
	$(RUN) pytest -m slow

lint: $(READY)
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy

format: $(READY)
	$(RUN) ruff check --fix .
	$(RUN) ruff format .

notebooks: $(READY)
	$(RUN) experiments.notebooks --write

dataset-env: $(BLENDER_READY)
	@echo "Blender is in $(BLENDER_VENV). Next: $(RUN) experiments.dataset.make --help"

benchmark-small: $(READY) $(BLENDER_READY)
	$(RUN) experiments.dataset.make --out=$(SMALL)/scenes --scenes=$(SMALL_SCENES) --size=100 \
		--train_views=50 --val_views=1 --test_views=8 --spp=64 --test_spp=256 \
		--texture_size=512 --exr=none --workers=2
	$(RUN) experiments.benchmark --scenes='$(SMALL)/scenes/*' --methods=straight,oracle,tree \
		--preset=tiny --steps=1250 --rays_per_pixel=4 --out=$(SMALL)/results

faults: $(READY)
	$(RUN) benchmarks.faults

paper-table: benchmark-small
	$(RUN) experiments.benchmark --scenes='$(SMALL)/scenes/*' --methods=paper,baselines,tree \
		--preset=tiny --steps=1250 --rays_per_pixel=4 --out=$(SMALL)/results
	@echo "The table is $(SMALL)/results/tables/main.md"

clean:
	rm -rf $(VENV) $(BLENDER_VENV) .mypy_cache .pytest_cache .ruff_cache *.egg-info

$(READY): pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: install it first."; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "The venv module is missing: on Debian, install \
	python3-venv."; exit 1; }
	$(RUN) pip install --quiet --disable-pip-version-check --editable \
	".[dataset,parquet,experiments,test,dev]"
	@touch $@

# An environment of its own: Blender's module runs in Python 3.11 alone, and with NumPy 1, which
# JAX no longer takes.
$(BLENDER_READY):
	@command -v python3.11 >/dev/null || { echo "Blender's module runs in Python 3.11 alone: \
	install that version beside your own, so that there is a command python3.11."; exit 1; }
	@python3.11 -m venv $(BLENDER_VENV) || { echo "The venv module is missing: on Debian, install \
	python3.11-venv."; exit 1; }
	$(BLENDER_VENV)/bin/python -m pip install --quiet --disable-pip-version-check "bpy==5.0.1" \
	"numpy<2"
	@touch $@
