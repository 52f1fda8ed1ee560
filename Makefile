# make         the same as make render
# make render  a first picture: fairy-lights with uniform and with guided lens sampling, into out/
# make test    the tests
# make clean   remove .venv and out/
# make help    this list

PYTHON ?= python3
VENV := .venv
EXTRAS ?= test
READY := $(VENV)/.ready-$(EXTRAS)

.PHONY: render test clean help

render: $(READY)
	$(VENV)/bin/python scripts/demo.py out

test: $(READY)
	$(VENV)/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

clean:
	rm -rf $(VENV) out

help:
	@sed -n 's/^# //p' Makefile

# Installed again only when what is to be installed has changed.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("bokehguide needs Python 3.11 or newer, and " \
	    "$(PYTHON) is " + sys.version.split()[0] + "; try make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@
