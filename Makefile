PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
PARALLEL := -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder

unexport PYTHONDONTWRITEBYTECODE # without bytecode, every process of a test compiles all modules anew

.PHONY: env demo test fast long slow bench docs agreement

env: $(READY) ## set up: a virtual environment with exact versions

$(READY): pyproject.toml constraints.txt .ci/system-packages
	PYTHON="$(PYTHON)" .ci/system-packages
	[ -x $(BIN)/python ] || "$(PYTHON)" -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	-$(BIN)/python -m twin.warm_up
	touch $@

demo: env ## a small complete survey; compiles the kernels first where the sources have changed
	-$(BIN)/python -m twin.warm_up
	$(BIN)/twin demo

test: env ## style, types and the fast tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(MAKE) fast

fast: env ## the fast tests
	$(BIN)/python -m pytest $(PARALLEL)

long: env ## small surveys, their reports and Monte Carlo references: tests of seconds each
	$(BIN)/python -m pytest -m 'long and not slow' $(PARALLEL)

slow: env ## whole surveys and benchmarks
	$(BIN)/python -m pytest -m slow

bench: env ## the cost of every stage as a ratio to its floor, compared with tests/benchmarks.toml
	$(BIN)/twin bench --against tests/benchmarks.toml

docs: env ## the documentation as a site, in site/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

agreement: env ## the gate of the surrogate: 64 rendered surveys, then docs/agreement.md and its figure
	$(BIN)/twin study agreement --out runs/study-agreement --resume; status=$$?; \
	cp runs/study-agreement/agreement.md runs/study-agreement/agreement.png docs/ && exit $$status
