# make install   the package and what it needs, in .venv
# make demo      simulates a session, calibrates it, writes the report
# make docs      the documentation as a site, in site/; any warning is an error
# make viewer    the viewer's bundle in src/pkmcal/web, from viewer/; needs Node 20.19 or newer
# make test      formatting, lint, types and tests, as the continuous integration does
# make clean     removes .venv and what tools left behind
#
# PYTHON=... names the interpreter (3.11 or newer) that .venv is made from.

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: install demo docs viewer test clean

install: $(VENV)/.installed

demo: install
	$(BIN)/pkmcal demo

# The home page shows the demo's report, made anew after a change of the program; a sentence stands
# in its place where that failed.
REPORT := build/demo/calibration/report.html

docs: $(VENV)/.test-tools $(REPORT)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

$(REPORT): $(VENV)/.installed $(shell find src -name '*.py')
	@mkdir -p build
	-$(BIN)/pkmcal demo --no-open -o build/demo

viewer: $(VENV)/.installed
	$(BIN)/python -c 'from pkmcal.web.document import schema_text; print(schema_text(), end="")' \
	    > src/pkmcal/web/schema.json
	cd viewer && npm ci --ignore-scripts && npm run build

test: $(VENV)/.test-tools
	@./.ci/chromium $(VENV)/.chromium-tried
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyrefly check --progress-bar no
	./.ci/checks $(BIN)

clean:
	rm -rf $(VENV) build dist site viewer/node_modules .pytest_cache .ruff_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamps: a second call does nothing until pyproject.toml changes. The installation is editable,
# so the sources need no stamp.
$(VENV)/.made:
	PYTHON="$(PYTHON)" ./.ci/venv $(VENV)
	@touch $@

$(VENV)/.installed: pyproject.toml $(VENV)/.made
	$(PIP) install --quiet --editable .
	@touch $@

$(VENV)/.test-tools: pyproject.toml $(VENV)/.installed
	$(PIP) install --quiet --editable '.[test]'
	@touch $@
