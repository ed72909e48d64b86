# make demo     the main job on a real robot; plots go to out/
# make test        every claim, on representative robots where a claim is about many; prints the slowest twenty tests
# make test-docs   code in docstrings and pages, notebooks, examples, site, packaging, types
# make test-all    both, on all robots and random trees, recordings and sizes
# make test-for    the tests that hold some files: make test-for FILES="torchdq/scene/state.py envs/walk.py"
# make regenerate  writes everything anew that is generated: indices, messages, records of operations, pages
# make prices      measures the tables of times of README and pages again, one after the other; the machine should be quiet
# make mutants     changes a copy of the sources in one place at a time; the suite must notice each mutant
# make docs        the documentation as static pages, in out/site; open out/site/index.html
# make dist        wheel and source archive, in dist/, as an index takes them
# make clean       removes the virtual environment and everything that was built
#
# All but the last make their own virtual environment in .venv, once; they run again without installing anything.
# Variables: PYTHON (3.11 or newer), TORCH (pip's arguments for torch), JOBS (test processes), ARGS (of the demo, of
# pytest, of mutants.py or of the scripts of prices), PRICES (names of those scripts).

PYTHON ?= python3
TORCH ?= torch==2.13.0
JOBS ?= auto
ARGS ?=
PRICES ?= peers envs batches rollouts compiled task_space inverse_kinematics export torch_files formulations \
  accuracy_vs_time

VENV := .venv
RUN := $(VENV)/bin/python
PIP := $(RUN) -m pip --disable-pip-version-check install
# a process takes neighbouring tests, which share robots, programs and fixtures
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(RUN) -m pytest -n $(JOBS) --dist worksteal --durations=20
DOCS := tests/docs torchdq

.PHONY: demo test test-docs test-all test-for regenerate prices mutants docs dist clean
.DELETE_ON_ERROR:

demo: $(VENV)/examples.installed
	$(RUN) examples/01_inverse_dynamics.py $(ARGS)

test: $(VENV)/test.installed
	$(PYTEST) $(ARGS)

test-docs: $(VENV)/test.installed
	$(PYTEST) $(or $(ARGS),$(DOCS))

test-all: $(VENV)/test.installed
	TORCHDQ_TESTS=all TORCHDQ_CFLAGS= $(PYTEST) $(or $(ARGS),tests $(DOCS))

test-for: $(VENV)/test.installed
	@FOUND=$$($(RUN) tests/tools/concerned.py $(FILES)) && set -x && $(PYTEST) $$FOUND

# messages last: they are those of the whole suite
regenerate: export PYTHONPATH := tests/tools:tests:tests/paper
regenerate: $(VENV)/test.installed
	$(RUN) tests/claims/test_operation_counts.py --write
	$(RUN) tests/claims/hard_cases/catalogue.py
	$(RUN) tests/backends/test_cuda_compile.py --write
	$(RUN) tests/paper/paper_index.py --write
	$(RUN) benchmarks/effects.py --write
	$(RUN) benchmarks/environments.py --write
	$(RUN) benchmarks/front_page.py --page
	$(RUN) benchmarks/diagrams.py --write
	$(RUN) benchmarks/terminals.py --write
	$(PYTEST) --update-messages

prices: $(VENV)/test.installed
	for name in $(PRICES); do $(RUN) benchmarks/$$name.py --page $(ARGS) || exit 1; done

mutants: $(VENV)/test.installed
	$(RUN) tests/mutants/mutants.py $(ARGS)

docs: $(VENV)/docs.installed
	OMP_NUM_THREADS=1 NO_MKDOCS_2_WARNING=1 TORCHDQ_NOTEBOOKS=run $(RUN) -m mkdocs build $(ARGS)

dist: $(VENV)/dist.installed
	rm -rf build dist
	$(RUN) -m build
	$(RUN) -m twine check --strict dist/*

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

# torch comes first and alone: a later requirement would pull a build with several gigabytes of CUDA libraries
$(VENV)/torch.installed:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "torchdq needs Python 3.11 or newer; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@echo "making the environment $(VENV), and installing $(TORCH) there, once"
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "$(PYTHON) cannot make a virtual environment; on Debian and Ubuntu: apt install python3-venv"; exit 1; }
	@$(PIP) $(TORCH) || \
	  { echo "cannot install $(TORCH); check the network, or name another build with: make TORCH=..."; exit 1; }
	@touch $@

# archives are built without torch
$(VENV)/dist.installed:
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) 'build>=1.2' 'twine>=6'
	@touch $@

$(VENV)/%.installed: $(VENV)/torch.installed pyproject.toml
	@echo "installing torchdq with the extra '$*' in $(VENV), once"
	@$(PIP) --editable '.[$*]' || \
	  { echo "cannot install the packages of the extra '$*'; check the network, then run make again"; exit 1; }
	@touch $@
