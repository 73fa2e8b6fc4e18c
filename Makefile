PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready

.PHONY: env demo test slow agreement

env: $(READY) ## set up: a virtual environment with exact versions

$(READY): pyproject.toml constraints.txt .ci/system-packages
	PYTHON="$(PYTHON)" .ci/system-packages
	[ -x $(BIN)/python ] || "$(PYTHON)" -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@

demo: env ## a small complete survey
	$(BIN)/twin demo

test: env ## style, types and the fast tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder

slow: env ## whole surveys and benchmarks
	$(BIN)/python -m pytest -m slow

agreement: env ## the gate of the surrogate: 64 rendered surveys, then docs/agreement.md and its figure
	$(BIN)/twin study agreement --out runs/study-agreement --resume; status=$$?; \
	cp runs/study-agreement/agreement.md runs/study-agreement/agreement.png docs/ && exit $$status
