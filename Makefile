# a pipe fails with any of its commands
SHELL := bash
.SHELLFLAGS := -o pipefail -ec
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# numbers that must not depend on the machine's locale or on a display
export MPLBACKEND := agg
# what the package says to OpenBLAS (lusee_bayes/__init__.py), for programs that import NumPy first
export OPENBLAS_THREAD_TIMEOUT ?= 20
# modules are compiled once, not by every process
unexport PYTHONDONTWRITEBYTECODE

.PHONY: map test essential long lint docs bench clean

# a posterior map of the embedded sky at 25 MHz, in output/first_map
map: $(VENV)/installed
	$(BIN)/lusee-bayes map

# a file's tests stay in one process: they share fixtures and compiled functions. Two processes also
# keep each below the number of memory maps that compiled programs may take up
test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile

# those longer checks that find most for their time
essential: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m "long and essential" -n 2 --dist loadfile

# the rest of the longer checks. Those that compute for longer than they compile come first, with
# LLVM's optimisations, and each by itself; two of them use both processors for a quarter of an hour
LONG := $(BIN)/python -m pytest -m "long and not essential" -n 2 -o faulthandler_timeout=7200
COMPUTING := $(addprefix tests/, sampling/test_hmc_full_size.py sampling/test_prior_amplitude.py \
	sampling/test_calibration.py systematics/test_calibration_of_systematics.py)
long: $(VENV)/installed-dev
	first=0; LUSEE_BAYES_TEST_XLA_LEVEL=3 $(LONG) --dist load $(COMPUTING) || first=$$?; \
	$(LONG) --dist loadfile $(addprefix --ignore=,$(COMPUTING)) && exit $$first

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

# the site, in docs/_build/html; every page is read anew, since only then its warnings are seen
docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx -E -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html
	# no page needs a file from the network
	! grep -rlE '<(script|img|link|iframe)[^>]* (src|href)="?(https?:)?//' docs/_build/html --include='*.html'

bench: $(VENV)/installed
	$(BIN)/python benchmarks/commands.py
	$(BIN)/python benchmarks/pipeline.py
	$(BIN)/python benchmarks/priors.py
	$(BIN)/python benchmarks/structured_noise.py
	$(BIN)/python benchmarks/diagnosis.py
	$(BIN)/python benchmarks/sampling.py

clean:
	rm -rf $(VENV) output docs/_build

$(VENV)/installed: pyproject.toml
	@echo "Installing into $(VENV): two to six minutes, the first time only"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --editable . | sed -n 's/^Collecting \([a-zA-Z0-9_-]*\).*/  \1/p'
	touch $@

$(VENV)/installed-dev: pyproject.toml $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

$(VENV)/installed-docs: pyproject.toml $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@
