# The two commands: `make run` and `make test`. Both set up everything they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# Packages are not compiled when they are installed: what is imported is compiled once and kept, in any environment.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test kernels accuracy nightly install chromium browser lint clean

run: $(STAMP)
	$(BIN)/python app.py

# Python's packages and the system's browser are fetched side by side; checking types and compiling kernels take a core
# each, and so do two halves of the tests: a file is never split, and the browser's, the longest, begin.
test:
	$(MAKE) -j2 $(STAMP) chromium
	$(MAKE) browser
	$(MAKE) -j2 --output-sync=target lint kernels
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

# Compiles the tracker's kernels once: tests with servers in other processes would each wait for them.
kernels: $(STAMP)
	$(BIN)/python -c "from dvsviz.config import TrackerConfig; from dvsviz.tracking.warm_up import warm_up; \
	  [warm_up(TrackerConfig(motion=motion)) for motion in ('planar', 'rotation', 'translation')]"

# Makes the suite, tracks it and prints measured beside wanted: a quarter of an hour on two cores.
accuracy: $(STAMP)
	$(BIN)/python benchmarks/accuracy.py --out out/accuracy --markdown out/accuracy/table.md --json out/accuracy/figures.json

# Hours: damaged files of every format, 2,000 of each.
nightly: $(STAMP)
	$(BIN)/python tests/fuzz_formats.py --cases 2000

install: $(STAMP) browser

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "dvsviz needs Python 3.11 or newer; set PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check -q --no-compile --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --disable-pip-version-check -q --no-deps --no-build-isolation -e .
	touch $(STAMP)

# The tests drive a real Chromium: the one on the PATH, else the system's package (as root), else Playwright's own.
HAS_CHROMIUM := command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null
chromium:
	@$(HAS_CHROMIUM) || \
	  { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium; } || \
	  true

browser: $(STAMP) chromium
	@$(HAS_CHROMIUM) || $(BIN)/python -m playwright install chromium

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --level warning

clean:
	rm -rf $(VENV) dist build *.egg-info
