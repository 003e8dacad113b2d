# make demo : the whole method on one held-out body, on the CPU, without a display
# make test : every check that the continuous integration runs
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test lint clean

demo: $(VENV)/.demo
	$(BIN)/giorom demo --out demo

test: $(VENV)/.test lint
	$(BIN)/python -m pytest

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell giorom tests docs README.md CHANGELOG.md
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV)

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# Off-screen rendering needs an OpenGL library; a bare Debian machine has none.
$(VENV)/.opengl: $(VENV)/bin/python
	@ldconfig -p 2>/dev/null | grep -q libEGL.so.1 || \
	  { echo "installing libegl1 and libgl1-mesa-dri for off-screen rendering"; \
	    $$( [ "$$(id -u)" = 0 ] || echo sudo ) sh -c 'apt-get -q update && apt-get -q install -y libegl1 libgl1 libgl1-mesa-dri'; }
	@touch $@

$(VENV)/.demo: pyproject.toml constraints.txt $(VENV)/.opengl
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all]'
	@touch $@

$(VENV)/.test: pyproject.toml constraints.txt $(VENV)/.opengl
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	@touch $@
