# `make run` and `make test` need Python 3.10, 3.11 or 3.12 and nothing else; all that they install goes into .venv.
VENV := .venv
PYTHON := $(VENV)/bin/python
IS_ALLOWED := import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))

.PHONY: run test report

# A first run: which boat, by UCB; how to sail it, by HyAR. More settings: make run ARGS="seed=1"
run: $(VENV)/.installed
	$(PYTHON) run.py high=ucb low=hyar $(ARGS)

test: $(VENV)/.installed
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m pytest -n auto $(ARGS)

# Figures, tables and pages of all studies, from their csv files: report/report.html
report: $(VENV)/.installed
	$(PYTHON) experiments/report.py

# A python on the PATH may be a stub that does not run (pyenv) or lack venv's pip (Debian), so each is tried.
$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import pip; $(IS_ALLOWED)' 2>/dev/null || { \
	    for python in python3.11 python3.12 python3.10 python3; do \
	        $$python -c 'import ensurepip; $(IS_ALLOWED)' 2>/dev/null && break; \
	        python=; \
	    done; \
	    test -n "$$python" || { echo "hpamdp needs Python 3.10, 3.11 or 3.12; there is none on the PATH" >&2; exit 1; }; \
	    echo "Making $(VENV) with $$($$python --version)"; \
	    $$python -m venv --clear $(VENV) || exit 1; \
	}
	@echo "Installing into $(VENV); the first time takes some minutes"
	@$(PYTHON) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@
