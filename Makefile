# `make play`, `make run` and `make test` need Python 3.10 to 3.14 and nothing else; all that they install goes into .venv.
VENV := .venv
PYTHON := $(VENV)/bin/python
IS_ALLOWED := import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 15))

# Environments of their own for `make slow`, `make lowest` and `make docs`.
SLOW := .venv-slow
RAY := .venv-ray-launcher
LOWEST := .venv-lowest
DOCS := .venv-docs

# Of all lines that Python executes: kernels run as machine code, which leaves no trace.
COVERAGE := --cov=hpamdp --cov-report=term:skip-covered --cov-fail-under=90
# The one slow test that needs the Ray launcher, which shares no environment with the others.
RAY_TEST := test_a_killed_sweep_is_finished_by_the_same_command and ray

.PHONY: play run test slow coverage slow-tests ray-launcher wheel lowest report docs

# Dock boats yourself, in the browser, beside agents. Ctrl-C ends it.
play: $(VENV)/.installed
	$(PYTHON) -m hpamdp.cli play $(ARGS)

# A first run: which boat, by UCB; how to sail it, by HyAR. More settings: make run ARGS="seed=1"
run: $(VENV)/.installed
	$(PYTHON) run.py high=ucb low=hyar $(ARGS)

# Each process of the tests has one core, and the threads of NumPy's matrix products would wait for one another.
test coverage slow-tests ray-launcher lowest: export OMP_NUM_THREADS = 1
# Bytecode is kept, since each process of the tests, and each that a test starts, would compile all modules anew.
test coverage slow-tests ray-launcher lowest: export PYTHONDONTWRITEBYTECODE =

# The gate: what every change has to pass.
test: $(VENV)/.installed-dev
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) tests/compile_kernels.py & $(PYTHON) -m mypy hpamdp && wait $$!
	$(PYTHON) -m pytest -n auto --dist worksteal $(ARGS)

# What takes longer, one after another: coverage, launchers, Ray, the wheel, the oldest dependencies.
slow:
	$(MAKE) coverage
	$(MAKE) slow-tests
	$(MAKE) ray-launcher
	$(MAKE) wheel
	$(MAKE) lowest

# The quick tests once more, under a tracer that doubles their time.
coverage: $(VENV)/.installed-dev
	$(PYTHON) -m pytest -n auto --dist worksteal $(COVERAGE) $(ARGS)

# All slow tests, and those quick ones that need an extra: a launcher for sweeps, a simulator. Those of the
# page of `make play` in a browser skip where there is no Chromium; on Debian, `apt-get install chromium` brings one.
slow-tests: $(SLOW)/.installed
	$(SLOW)/bin/python -m pytest -n 2 --dist worksteal -m slow -k 'not ($(RAY_TEST))' $(ARGS)
	$(SLOW)/bin/python -m pytest tests/test_sweeps.py -k 'not missing_launcher' $(ARGS)
	$(SLOW)/bin/python -m pytest tests/test_primitives.py tests/test_rddl.py $(ARGS)
	$(SLOW)/bin/python -m pytest tests/test_traffic.py tests/test_pages.py tests/test_default_dtype.py -k traffic $(ARGS)

ray-launcher: $(RAY)/.installed
	$(RAY)/bin/python -m pytest tests/test_sweeps.py -m slow -k '$(RAY_TEST)' $(ARGS)

# The source distribution, the wheel made of it, and a run of that wheel away from this folder.
wheel: $(SLOW)/.installed
	rm -rf $(SLOW)/wheel
	$(SLOW)/bin/python -m build --outdir $(SLOW)/wheel .
	$(SLOW)/bin/python -m pip install --quiet --no-deps --target $(SLOW)/wheel/site $(SLOW)/wheel/*.whl
	cd $(SLOW)/wheel && PYTHONPATH=site ../bin/python -c 'import hpamdp; assert "wheel/site" in hpamdp.__file__'
	cd $(SLOW)/wheel && PYTHONPATH=site site/bin/hpamdp \
	    high=ucb low=hyar total_frames=1024 num_envs=32 eval.layouts=10 eval.every=0
	cd $(SLOW)/wheel && PYTHONPATH=site site/bin/hpamdp play --export page

# The quick tests with the lowest versions that pyproject.toml allows.
lowest: $(LOWEST)/.installed
	$(LOWEST)/bin/python -m pytest -n auto --dist worksteal $(ARGS)

# Figures of all studies, tables and numbers of all pages, from the csv files
report: $(VENV)/.installed-dev
	$(PYTHON) experiments/report.py

# The documentation site, in site/: runs the tutorials, then builds the pages. Warnings are errors.
docs: $(DOCS)/.installed
	$(DOCS)/bin/python -m pytest tests/test_tutorials.py tests/test_pages.py -m 'slow or not slow' $(ARGS)
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/python -m mkdocs build

# A python on the PATH may be a stub that does not run (pyenv) or lack venv's pip (Debian), so each is tried.
define venv
@$(@D)/bin/python -c 'import pip; $(IS_ALLOWED)' 2>/dev/null || { \
    for python in python3.11 python3.12 python3.13 python3.10 python3.14 python3; do \
        $$python -c 'import ensurepip; $(IS_ALLOWED)' 2>/dev/null && break; \
        python=; \
    done; \
    test -n "$$python" || { echo "hpamdp needs Python 3.10 to 3.14; there is none on the PATH" >&2; exit 1; }; \
    echo "Making $(@D) with $$($$python --version)"; \
    $$python -m venv --clear $(@D) || exit 1; \
}
@echo "Installing torch and what else hpamdp needs into $(@D): 2 GB, or 7 GB with CUDA; the first time takes some minutes"
endef
INSTALL = @$(@D)/bin/python -m pip install --quiet --disable-pip-version-check

# What playing and runs need; tests need more.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(venv)
	$(INSTALL) -c constraints.txt -e .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(INSTALL) -c constraints.txt -e '.[dev]'
	@touch $@

$(SLOW)/.installed: pyproject.toml constraints.txt
	$(venv)
	$(INSTALL) -c constraints.txt -e '.[dev,sweeps,tune,ray,browser,video,traffic,robots,rddl]'
	@touch $@

# This launcher wants cloudpickle < 3, so it has constraints of its own; without them pip searches for an hour.
$(RAY)/.installed: pyproject.toml constraints-ray-launcher.txt
	$(venv)
	$(INSTALL) -c constraints-ray-launcher.txt -e '.[dev,ray-launcher]'
	@touch $@

$(LOWEST)/.installed: pyproject.toml constraints-lowest.txt
	$(venv)
	$(INSTALL) -c constraints-lowest.txt -e '.[dev]'
	@touch $@

$(DOCS)/.installed: pyproject.toml constraints.txt
	$(venv)
	$(INSTALL) -c constraints.txt -e '.[dev,docs]'
	@touch $@
