# Everything lives in .venv; nothing else has to be installed by hand.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint clean

demo: .venv/installed
	rm -rf out/demo out/demo-truth out/demo-run
	$(BIN)/tsmftis simulate out/demo --preset demo --seed 1
	$(BIN)/tsmftis run out/demo --out out/demo-run

test: .venv/installed
	$(BIN)/python -m pytest -n 2

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf .venv build out *.egg-info

# torch first and by its exact version: a range would let the resolver take a CUDA build of several gigabytes.
.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -qq --upgrade pip
	$(BIN)/python -m pip install -qq "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install -qq -c constraints.txt -e ".[dev,opus]"
	touch $@
