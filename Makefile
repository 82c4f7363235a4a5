# Everything from a fresh clone with only python3 (3.11 or newer) and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# With it, each of the hundreds of processes of the tests would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test slow-test lint format docs wheel-test python-test bench studies clean
.DELETE_ON_ERROR:

demo: $(VENV)/ready
	$(BIN)/fusion-service demo $(ARGS)

# Tests are processes beside each other: each computes in one thread. One more than cores: some wait for a bus.
test slow-test: export OMP_NUM_THREADS := 1
test slow-test: export OPENBLAS_NUM_THREADS := 1

test: lint
	$(BIN)/python -m pytest -q -n 3 --dist worksteal $(ARGS)

# The tests that take tens of seconds each, which `make test` leaves out.
slow-test: $(VENV)/ready
	$(BIN)/python -m pytest -q -n 3 --dist worksteal -m slow $(ARGS)

lint: $(VENV)/ready
	$(BIN)/ruff check -q .
	$(BIN)/ruff format -q --check .
	$(BIN)/mypy

format: $(VENV)/ready
	$(BIN)/ruff check -q --fix .
	$(BIN)/ruff format -q .

docs: $(VENV)/ready
	$(BIN)/python docs/site/build.py
	@echo "site/html/index.html"

wheel-test: $(VENV)/ready
	$(BIN)/python tests/wheel.py

# The quick tests under another Python: make python-test OTHER=python3.13
python-test:
	$(PYTHON) tests/other_python.py $(OTHER)

bench: $(VENV)/ready
	for name in codec bus rules mixtures centre; do OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.$$name || exit 1; done

studies: $(VENV)/ready
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m studies all $(ARGS)

$(VENV)/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: make PYTHON=python3.12" >&2; exit 1; }
	@echo "Setting up $(VENV) (once, about a minute) ..."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --require-hashes -r constraints.txt
	$(BIN)/pip install -q --no-deps --no-build-isolation -e .
	$(BIN)/python -m fusion_service.compiled
	touch $@

clean:
	rm -rf $(VENV) runs site dist
