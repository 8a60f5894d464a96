# make demo: set up and train; make test: set up, check, test; make bench: benchmarks beside their peers.
PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.installed
PINNED := --quiet --constraint constraints.txt
# pip finds a build of torch for the processor alone. All else is installed by uv, in a tenth of the time. It does not know
# your settings of pip: where it finds no package, pip goes on.
PIP := $(BIN)/pip install --disable-pip-version-check $(PINNED)

# Compiles all loops (Numba), if their code has changed. Otherwise the first command or each test would wait for it.
define COMPILE
$(BIN)/python -c 'import brakeline.safety.filter.filter, brakeline.safety.filter.kernels.window_kernels, \
		brakeline.safety.filter.kernels.window_rollout_kernels' & \
	$(BIN)/python -c 'import brakeline.safety.perception.occluded_regions as regions; regions.prepare(); \
		import brakeline.sim.kernels.flight_kernels as flight; flight.prepare(); \
		import brakeline.sim.kernels.arena_kernels, brakeline.sim.kernels.ray_kernels' && wait $$!
endef

.PHONY: demo setup test test-fast check style types compiled unit bench messages docs three safety-gymnasium bullet-safety-gym safe-control-gym clean

demo: setup
	$(BIN)/brakeline demo

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv || python3 -m venv .venv
	$(PIP) torch==2.13.0 uv
	VIRTUAL_ENV=.venv $(BIN)/uv pip install --system-certs --compile-bytecode $(PINNED) --editable '.[dev]' || \
		$(PIP) --editable '.[dev]'
	$(COMPILE)
	touch $(STAMP)

# The types are checked beside the tests: in their first minute, which records data, a core is idle.
test: style
	$(MAKE) --no-print-directory --jobs 2 types unit

check: style types

style: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tests/laws/imports.py

types: setup
	nice $(BIN)/mypy

# Compiles loops and tests once. Otherwise each process of the tests would compile them. If a test cannot
# be imported, the tests themselves say so.
compiled: setup
	$(COMPILE)
	-$(BIN)/python -m pytest --collect-only > /dev/null

# Real time in one process, real autopilots in another, whole runs in a third at a lower priority, the rest in a fourth
# at a still lower one, and in those that are through (tests/conftest.py); what was skipped, and why.
# What the processes of a few hundred runs import is compiled once, whatever the shell says.
unit: export PYTHONDONTWRITEBYTECODE =
# Four processes with two threads each on two cores wait for each other.
unit: export OMP_NUM_THREADS = 1
unit: compiled
	$(BIN)/python -m pytest -m "not long" -n 4 --dist loadscope --no-loadscope-reorder -rs

# For every save: no whole runs, no flights, no trainings.
test-fast: export PYTHONDONTWRITEBYTECODE =
test-fast: setup
	$(BIN)/ruff check .
	$(BIN)/python tests/laws/imports.py
	$(BIN)/python -m pytest -m "fast and not long"

bench: setup
	$(BIN)/python -m benchmarks

# docs/ as a static site with a search, in site/. Open site/index.html; it needs no server and no network.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# Regenerates messaging/brakeline_pb2.py and its stubs from the schema.
messages: setup
	$(BIN)/python -m grpc_tools.protoc -I. --python_out=. --mypy_out=. \
		--plugin=protoc-gen-mypy=$(BIN)/protoc-gen-mypy messaging/brakeline.proto

# Bundles the parts of three.js that the viewer of the pages uses. Needs npm; only to change them or their version.
three:
	folder=$$(mktemp -d) && cp logs/viewer/three.entry.js $$folder && cd $$folder && \
		npm install --silent three@0.187.0 esbuild@0.28.2 && npx esbuild three.entry.js --bundle --minify --format=iife \
		--global-name=THREE --legal-comments=inline --outfile=$(CURDIR)/logs/viewer/three.min.js && \
		cp node_modules/three/LICENSE $(CURDIR)/logs/viewer/three.LICENSE && rm -r $$folder

# Other authors' environments, each in a virtual environment of its own (docs/environments.md).
safety-gymnasium: examples/safety_gymnasium/.venv/.installed
examples/safety_gymnasium/.venv/.installed: examples/safety_gymnasium/requirements.txt examples/foreign/setup.sh
	PYTHON=$(PYTHON) sh examples/foreign/setup.sh safety_gymnasium safety-gymnasium==1.0.0

bullet-safety-gym: examples/bullet_safety_gym/.venv/.installed
examples/bullet_safety_gym/.venv/.installed: examples/bullet_safety_gym/requirements.txt examples/foreign/setup.sh
	PYTHON=$(PYTHON) sh examples/foreign/setup.sh bullet_safety_gym bullet-safety-gym==1.4.0

# Editable, so that the authors' trained policies come with it.
SAFE_CONTROL_GYM = git+https://github.com/utiasDSL/safe-control-gym@e39a5692a2989567b922f3033e50b49242896864
safe-control-gym: examples/safe_control_gym/.venv/.installed
examples/safe_control_gym/.venv/.installed: examples/safe_control_gym/requirements.txt examples/foreign/setup.sh
	PYTHON=$(PYTHON) sh examples/foreign/setup.sh safe_control_gym "--editable=$(SAFE_CONTROL_GYM)#egg=safe-control-gym"

clean:
	rm -rf .venv build site *.egg-info
