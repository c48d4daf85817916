# make train, make test: each does all set-up on a fresh machine, in a virtual environment of its own.
#   make train ARGS="--max_iterations 5"     make test ARGS="tests/test_env.py -k reset"
# make net A B compares what two commits or checkouts do:     make net main HEAD ARGS="--only recordings"
TASK ?= go1_flat
ARGS ?=
WORKERS ?= 2
VENV := .venv
BIN := $(VENV)/bin
# the first Python on the path that this project runs on
PYTHON ?= $(shell for p in python3.12 python3.11 python3.13 python3 python; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$p && break; done)

# a process that may not keep what it compiled of torch compiles all of it again: four seconds each, and tests start many
unexport PYTHONDONTWRITEBYTECODE

.PHONY: train play test net lint dist docs clean
train: $(VENV)/ready
	$(BIN)/python train.py --task $(TASK) $(ARGS)

play: $(VENV)/ready
	$(BIN)/python play.py --task $(TASK) $(ARGS)

test: $(VENV)/ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

# the two words after `net` are no targets
ifeq ($(firstword $(MAKECMDGOALS)),net)
SIDES := $(wordlist 2,3,$(MAKECMDGOALS))
.PHONY: $(SIDES)
$(SIDES): ; @:
endif
net: $(VENV)/ready
	$(BIN)/python tests/net/compare.py $(SIDES) $(ARGS)

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# wheel and sdist, checked as a package index would
dist: $(VENV)/ready
	$(BIN)/python -m pip install --quiet build twine
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*

docs: $(VENV)/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs $(or $(ARGS),build)

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache

# --no-compile: to compile all of torch at once takes longer than to fetch it; what is imported is compiled then
$(VENV)/ready: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "legged_mw needs Python 3.11, 3.12 or 3.13 on the PATH; or name one: make PYTHON=/path/to/python"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[dev]"
	touch $@
