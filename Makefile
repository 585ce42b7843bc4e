# The two set-up commands: `make demo` shows what the tool does, `make test` proves that it works.
# Both keep everything in .venv and install it on first use, with PYTHON (make demo PYTHON=python3.12).

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo

.PHONY: demo test test-all check docs links setup interpreter clean

demo: setup
	$(BIN)/pupper-sysid sweep --freqs 1-10 --joints LF --seed 1 --out $(DEMO)/sweep.csv --truth --force
	$(BIN)/pupper-sysid delay $(DEMO)/sweep.csv
	$(BIN)/pupper-sysid calibrate $(DEMO)/sweep.csv --out $(DEMO)/calibrated.yaml --force
	$(BIN)/pupper-sysid report $(DEMO)/sweep.csv --calibration $(DEMO)/calibrated.yaml --out $(DEMO)/report --force

# the quick tests; a worker more than two cores, for tests of real time wait a third of theirs
test: setup
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not slow"

# every page of the documentation and long campaigns besides
test-all: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal

check: setup links
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

docs: setup
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html

# the rooms as one package on disk, for tools that do not read setuptools' package-dir
links:
	mkdir -p build/links/pupper_sysid
	ln -sfn ../../../api/__init__.py build/links/pupper_sysid/__init__.py
	ln -sfn ../../../api/py.typed build/links/pupper_sysid/py.typed
	for room in common data servo_models hardware sysid sim policies cli; do \
		ln -sfn ../../../$$room build/links/pupper_sysid/$$room; done

setup: $(VENV)/.installed

# torch first, pinned: whatever asks for it later finds it and does not fetch CUDA
$(VENV)/.installed: pyproject.toml constraints.txt | interpreter
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null 2>&1 \
		|| $(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); echo "$(NO_VENV)" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

ANOTHER = make $(or $(MAKECMDGOALS),demo) PYTHON=python3.12
NEEDED = pupper-sysid needs Python 3.11 or newer; to name one: $(ANOTHER)
NO_VENV = $(PYTHON) could not create $(VENV). On Debian and Ubuntu, install python3-venv \
(python3.12-venv for python3.12). To name another Python: $(ANOTHER)
VERSION := -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null

# before pip runs: a Python that is new enough, and a .venv of the Python that was named
interpreter:
	@stop() { echo "$$1" >&2; exit 1; }; \
	named=$$($(PYTHON) $(VERSION)); present=$$($(BIN)/python $(VERSION)); \
	test -n "$$present" || test ! -e $(VENV)/.installed \
		|| stop "The Python of $(VENV) does not run any more. Run make clean, then make again."; \
	test -n "$$present$$named" || stop "$(PYTHON) does not run. $(NEEDED)"; \
	case "$$present" in 2.*|3.?|3.10) \
		stop "$(VENV) is of Python $$present. Run make clean first. $(NEEDED)";; esac; \
	case "$${present:-$$named}" in 2.*|3.?|3.10) \
		stop "$(PYTHON) is Python $$named. $(NEEDED)";; esac; \
	test -z "$$present" || test "$$present" = "$$named" || test "$(origin PYTHON)" = file \
		|| stop "$(VENV) is of Python $$present, $(PYTHON) is Python $${named:-?}. To change: make clean."

clean:
	rm -rf $(VENV) $(DEMO) build *.egg-info
