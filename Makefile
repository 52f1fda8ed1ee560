# make            the same as make render
# make render     a first picture: fairy-lights with uniform and with guided lens sampling, into out/
# make test       the essential tests
# make test-all   all tests, with those marked slow
# make lint       ruff (lint and format) and pyright
# make docs       the documentation, into out/site
# make blender    the add-on for Blender, into out/
# make test-blender  the tests of the add-on against Cycles; BLENDER=5.0 chooses the release (about 10 minutes, 1 GB)
# make results    every figure and table of docs/results, again (days; SETTING=reduced: one to two hours)
# make clean      remove .venv and out/
# make help       this list

PYTHON ?= python3
VENV := .venv
EXTRAS ?= test
SETTING ?= full
BLENDER ?= 4.5
BLENDER_PYTHON ?= python3.11
BLENDER_VENV := out/blender-$(BLENDER)
READY := $(VENV)/.ready-$(EXTRAS)
PYTEST := $(VENV)/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

.PHONY: render test test-all lint docs blender test-blender results clean help

render: $(READY)
	$(VENV)/bin/python scripts/quickstart.py out

test: $(READY)
	$(PYTEST) -m "not slow"

test-all: $(READY)
	$(PYTEST)

lint: $(VENV)/.ready-lint
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

docs: $(VENV)/.ready-docs
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict

blender:
	$(PYTHON) integrations/blender/build.py out

test-blender: $(READY) $(BLENDER_VENV)/.ready
	BOKEHGUIDE_PYTHON=$(abspath $(VENV)/bin/python) $(BLENDER_VENV)/bin/python -m pytest -c /dev/null -p no:cacheprovider \
	    --rootdir integrations/blender/tests integrations/blender/tests

results: $(READY)
	$(VENV)/bin/python scripts/results.py --setting $(SETTING)

clean:
	rm -rf $(VENV) out

help:
	@sed -n 's/^# //p' Makefile

# Lint and documentation run no render, so they compile nothing.
$(VENV)/.ready-lint $(VENV)/.ready-docs: export BOKEHGUIDE_NATIVE := 0

# Installed again only when pyproject.toml, constraints.txt or the native core has changed; the stem names the extras.
$(VENV)/.ready-%: pyproject.toml constraints.txt $(wildcard native/CMakeLists.txt native/*.cpp native/*.h)
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("bokehguide needs Python 3.11 or newer, and " \
	    "$(PYTHON) is " + sys.version.split()[0] + "; try make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet -c constraints.txt -e '.[$*]'
	@touch $@

# Blender as a Python module fits one version of Python: 3.11 for Blender 4.2 to 5.0.
$(BLENDER_VENV)/.ready:
	$(BLENDER_PYTHON) -m venv $(BLENDER_VENV)
	$(BLENDER_VENV)/bin/python -m pip install --quiet 'bpy==$(BLENDER).*' OpenEXR pytest
	@touch $@
