# make demo   install, train and probe a small synthetic scene
# make test   install, also the developers' tools, then ruff, pyright and pytest
# make test-everywhere   the tests as other processors run them, which takes hours
# make docs   the documentation as pages, in build/docs
# make test-release   the documentation, and a wheel in a new environment that runs every example, which takes minutes
# make setup  the shared first half: an environment in .venv with everything that the commands need
# make clean  remove the environment and builds; what you trained and measured, in runs/, stays
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TOOLS := $(VENV)/.tools-installed
# no-compile: a module is compiled when it is first imported; all of torch's take a minute
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt

# modules are kept compiled where Python is told otherwise, too: the tests start it over and over
export PYTHONDONTWRITEBYTECODE :=

.PHONY: setup demo test types pytest test-everywhere test-release docs clean
setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "expected Python 3.11 or newer, got " + sys.version.split()[0] + "; name one with: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV), which takes minutes and 1.5 GB"
	$(PIP) --editable '.$(EXTRA)'
	@touch $(STAMP) $(if $(EXTRA),$(TOOLS))

# where nothing is installed, the rule above installs these too, in one go
$(TOOLS): EXTRA := [dev]
$(TOOLS): $(STAMP)
	@test -e $(TOOLS) -a ! $(TOOLS) -ot $(STAMP) || $(PIP) --editable '.[dev]'
	@touch $(TOOLS)

demo: setup
	$(BIN)/landscape demo

test: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@$(MAKE) --no-print-directory --jobs 2 types pytest

types:  # of one core, beside the tests
	$(BIN)/pyright

pytest:
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal

test-everywhere: $(TOOLS)
	$(BIN)/python -m tests.everywhere

docs: setup
	$(PIP) --editable '.[docs]'
	$(BIN)/mkdocs build --strict --site-dir build/docs

test-release: $(TOOLS) docs
	$(BIN)/python -m tests.release

clean:
	rm -rf $(VENV) build *.egg-info
