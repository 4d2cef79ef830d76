PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test check package accuracy-gate bench bench-gate format clean

install: $(VENV)/.installed

# What users need; tests and tools, which take longer to install, come with the other targets.
$(VENV)/.usable: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[view]"
	touch $@

$(VENV)/.installed: $(VENV)/.usable
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

demo: $(VENV)/.usable
	$(BIN)/caryatid demo --out demo-run

test: install
	$(BIN)/python -m pytest -n auto

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

package: install
	$(BIN)/python -m pip install --quiet --constraint constraints.txt build twine
	$(BIN)/python tools/package.py

accuracy-gate: install
	$(BIN)/python benchmarks/accuracy.py suite --gate

# A peer that cannot be installed is a row of the benchmark that says so, and is tried again next time.
$(VENV)/.peers: $(VENV)/.installed
	for peer in open3d pyransac3d cgal; do \
		$(BIN)/python -m pip install --quiet --constraint constraints.txt $$peer || failed="$$failed $$peer"; \
	done; \
	if test -z "$$failed"; then touch $@; else echo "could not be installed:$$failed"; fi

bench: $(VENV)/.peers
	$(BIN)/python benchmarks/bench.py --docs docs/performance.md --out bench.json --update

bench-gate: $(VENV)/.peers
	$(BIN)/python benchmarks/bench.py --gate

format: install
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist demo-run
