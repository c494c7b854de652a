# Every task is the same on a laptop and in CI. `make help` lists them.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
JOBS   ?= 2
# `make MEDIAPIPE= unit` goes without; the tests of real video are skipped then
MEDIAPIPE ?= mediapipe
VIDEOS := .cache/pose2sim
# compiled where there is a C compiler; without one, NumPy does the same
KERNELS := $(wildcard src/imitarm/compiled/*.[ch]) src/imitarm/compiled/kernels.py
export MPLBACKEND = Agg
# one thread for each numerical library: this work is many small matrices, and the tests already run side by side
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help demo install test lint types floors unit quick mediapipe format bench tables pictures clean

help:  ## list the tasks
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

demo: $(VENV)/.report $(VENV)/.demo-compiled  ## learn a sweep from demonstrations, do it around obstacles, write demo/report.html
	$(BIN)/imitarm demo --force

install: $(VENV)/.dev $(VENV)/.compiled  ## the development environment in .venv

test: lint types floors unit  ## everything CI runs

lint: $(VENV)/.dev  ## style and documentation
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev  ## strict types of src
	$(BIN)/mypy

floors: $(VENV)/.dev  ## no import goes up
	$(BIN)/lint-imports

unit: $(VENV)/.dev $(VENV)/.compiled $(MEDIAPIPE)  ## the tests
	$(BIN)/pytest -n $(JOBS) --dist loadgroup

quick: $(VENV)/.dev $(VENV)/.compiled  ## the tests that your changes touch, the nearest first, in under a minute
	$(BIN)/python tests/quick.py

mediapipe: .venv-mediapipe/imitarm-mediapipe.txt $(VIDEOS)/cam04.mp4  ## video and webcam: MediaPipe's own environment, and real video for the tests

format: $(VENV)/.dev  ## fix what can be fixed mechanically
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.bench $(VENV)/.compiled  ## speed against installed peers, as ratios
	$(BIN)/python benchmarks/speed.py

DATA ?= ../shared/data
SKILLS := $(addprefix .cache/skills/,pouring.json letter_h.json bottle2shelf.json)
RESULTS := .cache/placements.jsonl
COMPARED = --skill $(SKILLS) --robots sawyer panda --tool gripper --out $(RESULTS)
tables: $(VENV)/.dev $(MEDIAPIPE) $(SKILLS)  ## print all tables of docs/ again, which takes hours; DATA=folder of real recordings
	$(BIN)/imitarm benchmark mapping --out benchmark-mapping --data $(DATA) --fill docs/mapping_benchmark.md
	$(BIN)/imitarm benchmark static --count 100 --torque 10 --memory 10 --out benchmark-static
	$(BIN)/imitarm benchmark static compare benchmark-static --fill docs/static_benchmark.md
	$(BIN)/imitarm benchmark avoidance --seeds 200 --fill docs/avoidance.md
	$(BIN)/imitarm benchmark tracking --data $(DATA) --fill docs/tracking.md
	$(BIN)/imitarm benchmark placements --skill $(SKILLS) --robots sawyer panda --tool gripper --seeds 334 --max-tilt 30 \
		--jobs $(JOBS) --fill docs/avoidance.md
	$(BIN)/imitarm benchmark placements --policies acfra rrt-connect $(COMPARED) --seeds 50 --max-tilt 30
	$(BIN)/imitarm benchmark placements --policies acfra rrt-connect $(COMPARED) --seeds 50
	$(BIN)/imitarm benchmark placements --policies rrt-connect-tilt $(COMPARED) --seeds 5
	$(BIN)/imitarm benchmark comparison $(RESULTS) --fill docs/avoidance.md
	$(BIN)/imitarm benchmark people $(DATA) $(VIDEOS)/cam01.mp4 $(VIDEOS)/cam02.mp4 --fill docs/real_data.md

.cache/skills/%.json: $(VENV)/.dev
	@mkdir -p $(@D)
	$(BIN)/imitarm learn $(DATA)/panda_kinesthetic/$*.npy --units cm --duration 10 --task $* --out $@ --force

pictures: demo  ## renew the pictures in docs/images, which needs Chromium, Chrome or Edge, and EGL
	$(BIN)/python scripts/take_picture.py demo/report.html docs/images/report.png --anchor scene-4-boxes-and-cone --seconds 40
	MUJOCO_GL=$${MUJOCO_GL:-egl} $(BIN)/python scripts/draw_thesis_figures.py docs/images

clean:  ## remove the environment and everything made
	rm -rf $(VENV) .venv-mediapipe .cache demo .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "imitarm needs Python 3.11 or newer; say make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.report: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[report]'
	@touch $@

$(VENV)/.demo-compiled: $(KERNELS) | $(VENV)/.report
	$(BIN)/python -m imitarm.compiled
	@touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

$(VENV)/.compiled: $(KERNELS) | $(VENV)/.dev
	$(BIN)/python -m imitarm.compiled
	@touch $@

$(VENV)/.bench: $(VENV)/.dev pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[dev,bench]'
	@touch $@

# order-only: neither changes with what imitarm needs
.venv-mediapipe/imitarm-mediapipe.txt: src/imitarm/capture/mediapipe_environment.py | $(VENV)/.dev
	$(BIN)/python -m imitarm.capture.mediapipe_environment .venv-mediapipe

$(VIDEOS)/cam04.mp4: tests/fetch_videos.py | $(VENV)/.dev
	$(BIN)/python tests/fetch_videos.py
