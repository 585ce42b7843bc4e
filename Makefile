# The two set-up commands: `make demo` shows what the tool does, `make test` proves that it works.
# Both keep everything in .venv and install it on first use.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo

.PHONY: demo test check docs links setup clean

demo: setup
	$(BIN)/pupper-sysid sweep --freqs 1-10 --joints LF --seed 1 --out $(DEMO)/sweep.csv --truth --force
	$(BIN)/pupper-sysid delay $(DEMO)/sweep.csv
	$(BIN)/pupper-sysid calibrate $(DEMO)/sweep.csv --out $(DEMO)/calibrated.yaml --force
	$(BIN)/pupper-sysid report $(DEMO)/sweep.csv --calibration $(DEMO)/calibrated.yaml --out $(DEMO)/report --force

test: setup
	$(BIN)/python -m pytest -n 2

check: setup links
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

docs: setup
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html

# the rooms as one package on disk, for tools that do not read setuptools' package-dir
links: setup
	mkdir -p $(VENV)/links/pupper_sysid
	ln -sfn ../../../api/__init__.py $(VENV)/links/pupper_sysid/__init__.py
	ln -sfn ../../../api/py.typed $(VENV)/links/pupper_sysid/py.typed
	for room in common data servo_models hardware sysid sim policies cli; do \
		ln -sfn ../../../$$room $(VENV)/links/pupper_sysid/$$room; done

setup: $(VENV)/.installed

# torch first, pinned: whatever asks for it later finds it and does not fetch CUDA
$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) $(DEMO) build *.egg-info
