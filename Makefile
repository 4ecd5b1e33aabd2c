# make demo    the whole workflow once: simulate, reconstruct, evaluate, report
# make test    the test suite without the slow tests; ROOM=renderer tests one room; make test-all runs everything
# make check   in under a minute: style, types, imports and the tests of what changed since the last commit
# make engine  the kernels alone, after a change to their sources, for this machine's instruction set: no pip, no network
# make guard   whether the last `make demo` still scores what it did
# make figures pictures with their tables: buildings, vehicles, splatting against ray casting, reconstructions, a village
# make bench   speed and memory beside plain PyTorch and beside the arithmetic alone; fills docs/reference/performance.md (3 minutes)
# make tables  every experiment, beside the paper's tables and other methods, to docs/results (hours; resumable);
#              QUICK=1 tries it in minutes, ONLY="density loss" runs some; those with measured chips need CHIPS, LABELS and
#              MASKS: the folder of MSTAR chips, their table and the folder of their masks
# make chips   what generated chips are worth to a classifier, with CHIPS and LABELS of MSTAR's ten classes (hours; resumable)
# make fuzz    malformed files for every reader (COUNT=40000 of each: resumable, hours); make sanitize  the engine under ASan and UBSan (needs Debian's clang-19)
# make wheels  a wheel for every platform in dist/ (four minutes the first time)
# make check-wheel  their contents; this machine's wheel is installed into an empty environment and tested there
# make docs    the documentation as a site, site/index.html, its tutorials executed (minutes the first time)
# make primer  the pictures of docs/learn/primer.md; make sweep  the README's animation, from the last `make demo`
# make lint    style and types
# make clean   remove everything created here, including the environment
#
# Needs Python 3.11 or newer, make and git; no compiler. Choose another interpreter with `make PYTHON=python3.12 demo`.
# What is installed grows with what is asked for: the demo's packages first, then the tests', then those of the docs.

PYTHON ?= $(shell for p in python3.11 python3; do "$$p" -c "" 2>/dev/null && { echo "$$p"; break; }; done)

SHELL := bash
# Python keeps what it compiles, whatever the environment says: otherwise every command would take three seconds more.
unexport PYTHONDONTWRITEBYTECODE
BIN := .venv/bin
DEMO_READY := .venv/.demo
TEST_READY := .venv/.test
DOCS_READY := .venv/.docs
ENGINE := src/sarsplat/renderer/_engine.so
KERNELS := build_engine.py $(wildcard src/sarsplat/renderer/csrc/*)
ALL_SETS := .venv/.engine
DEMO := demo
TARGETS := linux-x86_64 linux-aarch64 macos-arm64 windows-x86_64

# Of what pip says, the packages' names; its warnings are of folders and versions that are no business of ours.
NAMES := awk '/^(Collecting|Processing)/ { sub(/.*\//, "", $$2); sub(/(-[0-9]|[^a-zA-Z0-9_.-]).*/, "", $$2); printf " %s", $$2 } \
  /^Installing/ { print " ... installing" } { fflush() }'
define pip
PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --no-compile -c constraints.txt $(1) \
    2> >(grep -v '^WARNING' >&2) | $(NAMES)
endef

# Says what is done, does it, and says how long it took.
define step
@set -o pipefail; printf '\n==> %s\n' "$(1)"; begun=$$SECONDS; $(2) && printf '    (%s s)\n' $$((SECONDS - begun))
endef

.PHONY: demo setup engine check guard room test test-all figures bench tables chips fuzz sanitize wheels check-wheel docs notebooks primer sweep lint readme clean

demo: setup
	$(call step,simulate: a T-72-like target by ray casting (24 training views and 48 test views),\
	  $(BIN)/sarsplat simulate --target t72 --protocol paper --source raycast --out $(DEMO)/dataset --overwrite)
	$(call step,reconstruct: 3D Gaussians from the training views,\
	  $(BIN)/sarsplat reconstruct $(DEMO)/dataset --out $(DEMO)/run --overwrite)
	$(call step,evaluate: score the unseen views and the points; write the report,\
	  $(BIN)/sarsplat evaluate $(DEMO)/run)

guard:
	$(BIN)/python benchmarks/guard.py $(DEMO)/run

PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --durations 10

test: room $(TEST_READY)
	$(PYTEST) -m "not slow" tests/$(ROOM)

room:
	@[ -e "tests/$(ROOM)" ] || { \
	  echo "tests/$(ROOM) does not exist; ROOM is one of:" $(filter-out __pycache__,$(patsubst tests/%/,%,$(wildcard tests/*/))) >&2; exit 2; }

test-all: $(TEST_READY) $(DOCS_READY)
	$(PYTEST)

check: $(TEST_READY)
	$(call step,style,$(BIN)/ruff format --check && $(BIN)/ruff check)
	$(call step,types of the library (half a minute the first time),$(BIN)/mypy)
	$(call step,types of the tests (half a minute the first time),$(BIN)/mypy --config-file tests/mypy.toml)
	$(call step,imports and what changed,\
	  OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" tests/test_imports.py $$($(BIN)/python tests/changed.py))

# Guided by coverage where atheris can be installed, by chance elsewhere.
fuzz: $(TEST_READY)
	-$(BIN)/python -m pip install --quiet -c constraints.txt atheris
	$(BIN)/python tests/fuzz.py $(if $(COUNT),--inputs $(COUNT) --keep build/fuzz)

sanitize: $(TEST_READY)
	$(BIN)/python tests/sanitize.py

# Each with an engine for its platform; `make wheels TARGETS=linux-x86_64` makes one of them.
wheels: $(TEST_READY)
	rm -rf dist
	$(call step,wheels: $(TARGETS),\
	  for target in $(TARGETS); do SARSPLAT_TARGET=$$target $(BIN)/python -m hatchling build -t wheel || exit 1; done)

check-wheel: wheels
	$(call step,install the wheel into an empty environment and try it,$(BIN)/python tests/wheel.py)

# Also the tables of docs/reference/forward-model.md and docs/images/buildings.png.
figures: $(TEST_READY)
	$(call step,buildings: both forward models against the closed form,$(BIN)/python docs/draw_buildings.py)
	$(call step,splat against ray cast: one mesh through both forward models,$(BIN)/python docs/draw_splat_against_raycast.py)
	$(call step,vehicles beside measured chips,$(BIN)/python docs/draw_vehicles.py)
	$(call step,reconstructions: where points are wrong and what is missed,$(BIN)/python docs/draw_reconstructions.py)
	$(call step,inverse SAR: a satellite and an aircraft,$(BIN)/python docs/draw_isar.py)
	$(call step,village: truth and points of a larger scene (minutes),$(BIN)/python docs/draw_village.py)
	$(call step,conditions: vehicles on speckled ground (a minute),$(BIN)/python docs/draw_conditions.py)
	$(call step,maps: heights of a village from above (minutes),$(BIN)/python docs/draw_maps.py)
	$(call step,terrain: a hill's layover and shadow,$(BIN)/python docs/draw_terrain.py)
	$(call step,CPHD: what is imaged of made-up files (a minute),$(BIN)/python docs/draw_cphd.py)
	$(call step,geocoded: two views on a map and back,$(BIN)/python docs/draw_geocoded.py)
	$(call step,stacks: a slice through layover,$(BIN)/python docs/draw_stacks.py)
	$(call step,channels: the signs of stacks,$(BIN)/python docs/draw_channels.py)
	$(call step,polarimetry: four kinds of scattering (minutes),$(BIN)/python docs/draw_polarimetry.py)
	$(call step,imports: which file imports which,$(BIN)/python docs/draw_imports.py)

bench: $(TEST_READY)
	$(call step,bench: speed and memory of every part (takes minutes; keep the machine idle),\
	  $(BIN)/python benchmarks/bench.py --out benchmarks/results)
	$(call step,docs/reference/performance.md from benchmarks/results,$(BIN)/python benchmarks/performance_page.py)

# Finished runs stay in runs/tables: end it at any time and start it again.
tables: $(TEST_READY)
	$(BIN)/python experiments/tables.py $(if $(QUICK),--quick) $(if $(ONLY),--only $(ONLY)) \
	  $(if $(CHIPS),--chips $(CHIPS) --labels $(LABELS)) $(if $(MASKS),--masks $(MASKS))

# Finished networks stay in docs/results/chips-runs.csv, reconstructions and chips in runs/chips: end it at any time.
chips: $(TEST_READY)
	$(BIN)/python experiments/chips.py $(if $(CHIPS),--chips $(CHIPS)) $(if $(LABELS),--labels $(LABELS))

# Warnings are errors: links and anchors that lead nowhere among them.
docs: notebooks
	$(call step,docs: the site,NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet)
	@echo 'next: open site/index.html in a browser'

# Kept in build/notebooks until the tutorial or the library changes.
notebooks: $(TEST_READY) $(DOCS_READY)
	$(call step,notebooks: execute the tutorials that changed,$(BIN)/python docs/site_tutorials.py)

primer: $(TEST_READY)
	$(BIN)/python docs/draw_primer.py

sweep: $(TEST_READY)
	$(BIN)/python docs/draw_sweep.py $(DEMO)/run

lint: $(TEST_READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/mypy --platform win32 --cache-dir .mypy_cache/windows src
	$(BIN)/mypy --config-file tests/mypy.toml

# The README's picture and table, from the last `make demo`.
readme: $(TEST_READY)
	$(BIN)/python docs/readme_results.py $(DEMO)/run

clean:
	rm -rf .venv $(DEMO) figures build dist site .pytest_cache .mypy_cache .ruff_cache src/sarsplat/renderer/_engine.*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

setup: $(DEMO_READY) $(ALL_SETS)

engine: $(ENGINE)

$(ENGINE): $(KERNELS) | $(DEMO_READY)
	$(call step,engine: the kernels for this machine's instruction set,$(BIN)/python build_engine.py --here)

# What tests, wheels and the demo use.
$(ALL_SETS): $(KERNELS) | $(DEMO_READY)
	$(call step,engine: the kernels for every instruction set,$(BIN)/python build_engine.py)
	@touch $@

# The engine is compiled while pip works.
$(DEMO_READY): pyproject.toml constraints.txt
	@"$(PYTHON)" -c "import sys; sys.exit(sys.version_info < (3, 11))" 2>/dev/null || { \
	  echo "sarsplat needs Python 3.11 or newer, but PYTHON is '$(PYTHON)'; name one: make PYTHON=/path/to/python3.11" >&2; \
	  exit 1; }
	$(call step,set up .venv for the demo (once; a minute or two),\
	  "$(PYTHON)" -m venv .venv \
	  && $(call pip,hatchling editables ziglang) \
	  && { $(BIN)/python build_engine.py & } \
	  && $(BIN)/python build_engine.py --requirements simulate evaluate report > .venv/requirements.txt \
	  && $(call pip,-r .venv/requirements.txt) \
	  && wait $$! \
	  && $(call pip,--no-build-isolation --no-deps -e .))
	@touch $@ $(ALL_SETS)

$(TEST_READY): $(DEMO_READY) | $(ALL_SETS)
	$(call step,set up .venv for the tests (once; a minute),$(call pip,--no-build-isolation -e '.[test]'))
	@touch $@

$(DOCS_READY): $(TEST_READY)
	$(call step,set up .venv for the documentation (once),$(call pip,--no-build-isolation -e '.[docs]'))
	@touch $@
