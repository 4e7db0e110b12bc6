# make demo | make test | make docs: all the set-up there is. Another interpreter: make PYTHON=python3.12 test
PYTHON ?= python3
PYTEST_FLAGS ?= -n 2
# The matrices are small: more threads only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

.PHONY: demo test lint docs clean

demo: .venv/.demo
	$(BIN)/python examples/acrobot_em.py

test: lint docs
	$(BIN)/pytest $(PYTEST_FLAGS)

lint: .venv/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

docs: .venv/.test
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:
	rm -rf .venv .cache .pytest_cache .ruff_cache .hypothesis build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.version_info >= (3, 11) or \
	sys.exit("nnap_em needs Python 3.11 or newer; $(PYTHON) is " + v + ". Name a newer one: make PYTHON=python3.11")'
	$(PYTHON) -m venv --clear .venv

.venv/.demo: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .
	@touch $@

.venv/.test: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable '.[test,docs]'
	@touch $@ .venv/.demo
