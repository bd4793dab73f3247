# make demo: everything set up, four modes compared on the embedded data. make test: everything set up, all tests.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test test-whole check lint docs archive-page audit lower-bounds mutants sanitize wheel results setup engine clean

demo: engine
	$(BIN)/ekfslam compare builtin:city --out results/local

test: engine
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest

# The slow tests at their full length, about an hour on two cores.
test-whole: engine
	OPENBLAS_NUM_THREADS=1 EKFSLAM_TESTS=whole $(BIN)/python -m pytest

# Form, types and the fast tests: before every commit.
check: engine lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow and not data"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror ekfslam/engine/*.?pp
	$(BIN)/mypy

# The documentation as a site in build/site, without a network: no warning, no dead link.
docs: $(VENV)/.docs
	OPENBLAS_NUM_THREADS=1 NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "open build/site/index.html"

# Licences of the dependencies against a stated list, and their known vulnerabilities if the network can be reached.
audit: $(READY)
	VENV="$(VENV)" sh .ci/audit

# Part of the tests, in an environment of its own with the oldest versions that pyproject.toml allows.
lower-bounds:
	PYTHON="$(PYTHON)" sh .ci/lower-bounds

# Mutants of some files against some tests, by default of the live inputs: make mutants FILES=... TESTS=... COUNT=200
FILES ?= ekfslam/filters/door.py ekfslam/filters/streams.py ekfslam/filters/live.py
TESTS ?= tests/test_door.py tests/test_streams.py tests/test_live.py tests/test_live_robust.py
COUNT ?= 60
mutants: engine
	$(BIN)/python tests/mutants.py $(FILES) --tests $(TESTS) --count $(COUNT)

# The engine with the sanitizers of the compiler, which find wrong addresses and undefined behaviour.
sanitize: $(READY)
	VENV="$(VENV)" sh .ci/sanitize

# A wheel in build/wheel.
wheel: $(READY)
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/wheel .

# What is committed under results/, where it needs recordings only if they are present. About half an hour on two cores.
results: engine
	$(BIN)/python experiments/compare_modes.py
	$(BIN)/python experiments/reproduce_report.py
	$(BIN)/python experiments/monte_carlo.py
	$(BIN)/python experiments/published_results.py
	$(BIN)/python experiments/starry_night.py
	$(BIN)/python experiments/real_data.py
	$(BIN)/python experiments/ablation.py
	$(BIN)/python experiments/scaling.py
	$(BIN)/python experiments/benchmark.py
	$(BIN)/python experiments/front_end.py
	@if $(BIN)/python -c "import gtsam" 2>/dev/null; then $(BIN)/python experiments/map_against_gtsam.py; \
	else echo "results/map is left as it is: pip install 'ekfslam[bench]' for map_against_gtsam.py"; fi

# The page on the archive format, from the code.
archive-page: $(READY)
	$(BIN)/python docs/make_archive.py

setup: engine

# What has changed in C++ is compiled; the first time takes a minute on two cores.
engine: $(READY)
	@[ -f build/engine/build.ninja ] || $(BIN)/cmake -G Ninja -S ekfslam/engine -B build/engine --log-level=WARNING \
	    -DCMAKE_MAKE_PROGRAM="$(CURDIR)/$(BIN)/ninja" -DPython_EXECUTABLE="$(CURDIR)/$(BIN)/python" >/dev/null
	@$(BIN)/cmake --build build/engine -- --quiet

$(READY): pyproject.toml .ci/setup
	PYTHON="$(PYTHON)" VENV="$(VENV)" sh .ci/setup
	@touch $@

$(VENV)/.docs: $(READY)
	EKFSLAM_WITHOUT_ENGINE=1 $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) build *.egg-info results/local
