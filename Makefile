# Everything a person or CI needs. `make demo` first; `make help` lists the rest.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SYSTEM := python3-venv python3-gi gir1.2-aravis-0.8 libgl1 libegl1 libx11-6 libusb-1.0-0 libudev1 libgomp1
TEST_SYSTEM := chromium mbpoll
ARGS ?=

.PHONY: help demo test check fast bench fit lint schema install install-test clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

demo: $(STAMP)  ## the simulated cell: two GigE cameras, the daemon, a PLC that empties the bin (ARGS="--headless --cycles 5")
	@$(BIN)/binpick demo $(ARGS)

install: $(STAMP)  ## system packages and the virtual environment

$(STAMP): pyproject.toml constraints.txt
	@deploy/install-packages $(SYSTEM)
	@test -x $(BIN)/pip || /usr/bin/python3 -m venv --system-site-packages $(VENV)
	@echo "Installing Python packages (1.5 GB on disk, 2 to 5 minutes) ..."
	@deploy/install-python $(VENV) hatchling editables
	@deploy/install-python $(VENV) --no-build-isolation --editable '.[sim,dev]'
	@echo "Compiling the loops over pixels ..."
	@$(BIN)/python -c 'from binpick.settings.stereo import PRESETS; from binpick.stereo import depth; [depth.warm(p) for p in PRESETS.values()]'
	@touch $@

install-test: $(STAMP)
	@deploy/install-packages $(TEST_SYSTEM)
	@deploy/install-conformance $(BIN)

lint: $(STAMP)
	$(BIN)/ruff check service calib tests
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

check: $(STAMP)  ## lint, types, contracts, unit and contract tests, one in-process cycle (under 2 minutes)
	@$(MAKE) --no-print-directory --jobs=2 lint fast

fast:
	$(BIN)/pytest -q tests/unit tests/contract -m "not slow"

test: install-test lint  ## everything that CI runs
	$(BIN)/pytest

bench: $(STAMP)  ## accuracy and speed on the frozen exam (ARGS="cameras --soak 600": pairs for 10 minutes; or --reconnects 200)
	$(BIN)/binpick bench $(ARGS)

fit: $(STAMP)  ## fit anew what counts as measured, on the exam's tuning seeds (stereo/weights.py)
	$(BIN)/python -m binpick.lab.fit

schema: $(STAMP)  ## regenerate the generated files of deploy/ and the list of modules in DECISIONS
	$(BIN)/binpick schema >deploy/cell.schema.json
	$(BIN)/python -c 'from binpick.publish import rest; print(rest.openapi_text(), end="")' >deploy/openapi.json
	$(BIN)/python -c 'from binpick.publish import registers; print(registers.csv(), end="")' >deploy/register-map.csv
	$(BIN)/python tests/unit/test_house.py

clean:  ## remove what was installed and built
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache out
