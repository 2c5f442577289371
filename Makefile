# Two commands for a newcomer: make demo, make test. Both make .venv and install into it first.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed
DEMO := .venv/.demo
# Arrays here are small: threads inside numpy and torch only cost time.
export OMP_NUM_THREADS ?= 1

.PHONY: install demo test test-full lint types docs clean

install: $(INSTALLED)

PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e

# What a run needs; tests, docs and notebooks need more.
$(DEMO): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) '.[train,cli,report,analysis]'
	touch $@

$(INSTALLED): $(DEMO)
	$(PIP) '.[dev]'
	touch $@

# An interrupted demo goes on where it stopped.
demo: $(DEMO)
	$(BIN)/hybrid-mpc run golf_robot --budget quick --out runs/demo $(if $(wildcard runs/demo/run.json),--resume)

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	$(BIN)/mypy --num-workers 2

test: lint types
	$(BIN)/python -m pytest -m 'not full' -n 2 --dist loadfile --no-loadscope-reorder -q --durations=8

test-full: lint types
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -q --durations=20

# The site, in build/site; broken links and references stop it.
docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

clean:
	rm -rf .venv build runs/demo
