# A bare machine needs Python 3.11 and a package index; everything else is made here, inside .venv.
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3; do \
	$$name -c '' 2> /dev/null && { echo $$name; break; }; done)
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := torch,video,telemetry,elevation,export,train,tune,distributed,parquet,dev

.PHONY: demo test test-all lint quick oldest onboard peers figures gpu

demo: $(STAMP)
	$(BIN)/dddas demo --out demo-out

# What a change needs: lint, types and the quick tests.
test: lint quick

quick: $(STAMP)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m "not slow and not browser and not gpu"

# The quick tests with the oldest release of each dependency that pyproject.toml admits.
oldest:
	test -x .venv-oldest/bin/python || $(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check uv
	VIRTUAL_ENV=.venv-oldest .venv-oldest/bin/uv pip install --quiet --resolution lowest-direct --editable '.[$(EXTRAS)]'
	.venv-oldest/bin/python -m pytest --numprocesses 2 --dist loadfile -m "not slow and not browser and not gpu"

# Everything: the slow tests, those in a browser, and the install without torch too.
test-all: test onboard
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m "slow or browser or gpu"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# On a machine with an accelerator: the tests that need one, and how fast it is beside OpenCV.
gpu: $(STAMP)
	$(BIN)/python -m pytest -m gpu
	$(BIN)/python eval/speed.py gpu

# The wheel with nothing but its own dependencies, as on a vehicle: does it work without torch?
onboard: .venv-onboard/.installed
	.venv-onboard/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --force-reinstall .
	.venv-onboard/bin/python -I tests/torch_free.py

.venv-onboard/.installed: pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check .
	@touch $@

# Tables of the documents from the results that studies keep in docs/results: none of their figures is typed.
figures: $(STAMP)
	$(BIN)/python eval/figures.py

# Other trackers and TrackEval, in environments of their own: they bring an OpenCV that breaks ours. Then: are our
# tracking measures TrackEval's? With DATA, a folder of sequences with identities: on them as well, and how well do we
# keep identities beside the other trackers? WRITE=docs/results/identities.json keeps that; what the peers got is kept in
# the file KEEP and not measured again while tables and settings are the same.
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

# The stamp makes a second run quick; a change of pyproject.toml installs again.
$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "torchvision-dddas needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$(EXTRAS)]'
	@touch $@
