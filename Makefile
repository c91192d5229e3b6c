# A bare machine needs Python 3.11 and a package index. Everything else is installed into .venv: by `make demo` the package
# with its own dependencies, by the other targets also the extras, which take minutes.
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3; do \
	$$name -c '' 2> /dev/null && { echo $$name; break; }; done)
VENV ?= .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.installed-base
STAMP := $(VENV)/.installed
EXTRAS := torch,video,telemetry,elevation,grid,photos,export,train,tune,distributed,parquet,docs,dev

.PHONY: demo test test-all test-python lint quick oldest onboard dist docs tutorials peers figures gpu

demo: $(BASE)
	$(BIN)/dddas demo --out demo-out

# The checks that every change must pass: lint, types and the quick tests.
test: lint quick

quick: $(STAMP)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m "not slow and not browser and not gpu"

# The quick tests with the oldest release of each dependency that pyproject.toml admits.
oldest:
	test -x .venv-oldest/bin/python || $(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check uv
	VIRTUAL_ENV=.venv-oldest .venv-oldest/bin/uv pip install --quiet --resolution lowest-direct --editable '.[$(EXTRAS)]'
	.venv-oldest/bin/python -m pytest --numprocesses 2 --dist loadfile -m "not slow and not browser and not gpu"

# The quick tests with each installed Python from 3.11 to 3.13, including those of pyenv, which are not on the path.
OTHERS ?= 3.11 3.12 3.13
test-python:
	@for version in $(OTHERS); do \
		for python in "$$(command -v python$$version)" "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/$$version.*/bin/python; do \
			if "$$python" -c '' 2> /dev/null; then \
				$(MAKE) quick PYTHON="$$python" VENV=.venv-$$version || exit; continue 2; \
			fi; \
		done; \
		echo "no Python $$version: its tests are left out" >&2; \
	done

# All checks: also the slow tests, the tests in a browser, and the install without torch.
test-all: test onboard
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m "slow or browser or gpu"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# On a machine with an accelerator: run the tests that need it, and measure its speed beside OpenCV.
gpu: $(STAMP)
	$(BIN)/python -m pytest -m gpu
	$(BIN)/python eval/speed.py gpu

# Test the wheel with only its own dependencies and without torch, as on a vehicle.
onboard: .venv-onboard/.installed
	.venv-onboard/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --force-reinstall .
	.venv-onboard/bin/python -I tests/torch_free.py

.venv-onboard/.installed: pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check .
	@touch $@

# Build the files of a release in dist/, and check them for a package index.
dist: .venv-dist/.installed
	rm -rf dist
	.venv-dist/bin/python -m build --outdir dist .
	.venv-dist/bin/twine check --strict dist/*
	.venv-dist/bin/check-wheel-contents dist/*.whl

.venv-dist/.installed: Makefile
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check build twine check-wheel-contents
	@touch $@

# Build the site of docs/ in build/site, without a network. A warning, such as a broken link, is an error.
docs: $(STAMP)
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs build/site

# Run the ten tutorials, and copy their pictures into docs/.
tutorials: $(STAMP)
	for script in docs/tutorials/*.py; do \
		mkdir -p build/tutorials/$$(basename $$script .py) && cd build/tutorials/$$(basename $$script .py) && \
		PATH="$(abspath $(BIN)):$$PATH" MPLBACKEND=agg $(abspath $(BIN))/python $(CURDIR)/$$script && \
		cp $$(basename $$script .py).??g $(CURDIR)/docs/tutorials/ && cd $(CURDIR) || exit 1; done

# Write the tables of the documents from the results of studies in eval/results. No figure is typed by hand.
figures: $(STAMP)
	$(BIN)/python eval/figures.py

# Install other trackers and TrackEval into separate environments, because their OpenCV breaks ours. Compare our tracking
# measures with TrackEval's. With DATA, a folder of sequences with identities, also compare on these sequences, and
# compare our identities with those of the other trackers. WRITE=eval/results/identities.json saves that result. KEEP
# names a file of the peers' results, which are not measured again while tables and settings are unchanged.
peers: $(STAMP) .venv-peers/.installed .venv-norfair/.installed
	$(BIN)/python eval/peers/check.py $(DATA)
ifdef DATA
	$(BIN)/python eval/peers/identities.py $(DATA) $(if $(KEEP),--keep-peers $(KEEP)) $(if $(WRITE),--write $(WRITE))
endif

.venv-peers/.installed: eval/peers/requirements.txt
.venv-norfair/.installed: eval/peers/requirements-norfair.txt
.venv-peers/.installed .venv-norfair/.installed:
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

# The stamps avoid a second installation, until pyproject.toml changes.
$(BASE): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "torchvision-dddas needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(STAMP): $(BASE)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$(EXTRAS)]'
	@touch $@
