# make demo | make test | make test-slow | make docs: all the set-up there is. Another interpreter: make PYTHON=python3.12 test
PYTHON ?= python3
# A worker takes whole files, so that what a file sets up is made once; tests/costs.py has the order.
PYTEST_FLAGS ?= -n 2 --dist loadfile --no-loadscope-reorder --durations 20
# What `make matrix` runs, and with which interpreters; one that is not there is left out.
MATRIX_PYTHONS ?= python3.11 python3.12 python3.13
MATRIX_FLAGS ?= -n 2 -m "not slow"
# The matrices are small: more threads only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1

BIN := .venv/bin
# What is never imported, nine tenths of it, need not be compiled; what is, is written beside its source.
PIP := $(BIN)/python -m pip --disable-pip-version-check install --no-compile --quiet --constraint constraints.txt
unexport PYTHONDONTWRITEBYTECODE

SITE := NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

.PHONY: demo test test-slow check lint docs gallery notebook matrix clean

demo: .venv/.demo
	$(BIN)/python examples/acrobot_em.py

# Types and the site are checked beside the tests.
test: .venv/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	{ $(BIN)/pyrefly check --summary=none && $(SITE); } & beside=$$!; \
	$(BIN)/pytest $(PYTEST_FLAGS) -m "not slow" && wait $$beside

# Long fits, many seeds, kill and resume of real searches, shapes and types of arguments checked, which takes a third of
# the time. SLOW="tests/test_design.py ...": those files alone.
test-slow: .venv/.test
	$(BIN)/pytest $(PYTEST_FLAGS) --jaxtyping-packages=nnap_em,beartype.beartype -m slow $(SLOW)

# Before each commit: lint, types and the tests that compile no large program.
check: .venv/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyrefly check --summary=none & types=$$!; $(BIN)/pytest $(PYTEST_FLAGS) --durations 3 -m "not slow and not large" && wait $$types

lint: .venv/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyrefly check --summary=none

docs: .venv/.test
	$(SITE)

# The pictures of docs/gallery.md; runs that are in out/gallery are not repeated.
gallery: .venv/.examples
	$(BIN)/python examples/gallery.py

notebook: .venv/.examples
	$(BIN)/jupytext --to ipynb examples/tour.py

# The oldest accepted versions are those of constraints.txt, the newest what pyproject.toml lets through.
matrix:
	@failed=; for python in $(MATRIX_PYTHONS); do \
		$$python -c "" 2>/dev/null || { echo "== $$python: not on this machine"; continue; }; \
		for age in oldest newest; do \
			bin=.venv-matrix/$${python##*/}-$$age/bin; \
			test $$age = oldest && bounds="--constraint constraints.txt" || bounds="--upgrade --upgrade-strategy eager"; \
			{ test -x $$bin/python || $$python -m venv $${bin%/bin}; } && \
			$$bin/python -m pip --disable-pip-version-check install --quiet $$bounds --editable '.[test]' && \
			echo "== $$python, $$age:" $$($$bin/python -m pip freeze | grep -E "^(jax|equinox|diffrax|optax|numpy)==") && \
			$$bin/pytest $(MATRIX_FLAGS) || failed="$$failed $$python-$$age"; \
		done; \
	done; test -z "$$failed" || { echo "failed:$$failed"; exit 1; }

clean:
	rm -rf .venv .venv-matrix .cache .pytest_cache .ruff_cache .hypothesis build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.version_info >= (3, 11) or \
	sys.exit("nnap_em needs Python 3.11 or newer; $(PYTHON) is " + v + ". Name a newer one: make PYTHON=python3.11")'
	$(PYTHON) -m venv --clear .venv

.venv/.demo: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable '.[examples]'
	@touch $@

.venv/.test: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable '.[test,docs]'
	@touch $@ .venv/.demo

.venv/.examples: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable '.[examples,robots]'
	@touch $@
