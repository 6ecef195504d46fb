# `make` lists the targets. Those that need .venv/ make it first if it is missing or older than pyproject.toml or
# constraints.txt.

PYTHON ?= python3
VENV := .venv
CLIENTS := .venv-clients
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help demo wheel test docs lint clients clean
.DELETE_ON_ERROR:

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(STAMP) ## simulate jumps; writes metrics, plots, pictures, a film and recordings to outputs/demo
	$(VENV)/bin/python experiments/demo.py --out outputs/demo

wheel: ## build dist/jumper_warp-VERSION-py3-none-any.whl
	$(PYTHON) -m pip wheel --no-deps --wheel-dir dist .

test: $(STAMP) ## run all tests, and check the import rules
	$(VENV)/bin/lint-imports --no-logo
	$(VENV)/bin/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder

docs: $(STAMP) ## build the documentation site in docs/_build/html; warnings are errors
	$(VENV)/bin/python -m sphinx -b html -q -W --keep-going -j 2 docs docs/_build/html
	@echo "open docs/_build/html/index.html"

lint: $(STAMP) ## check style, words, import rules and types
	$(VENV)/bin/pre-commit run --all-files

clients: ## test the use with TorchRL, skrl, OpenVINO and W&B, installed in .venv-clients
	$(PYTHON) -m venv $(CLIENTS)
	$(CLIENTS)/bin/python -m pip install -c constraints.txt -e ".[dev]"
	$(CLIENTS)/bin/python -m pip install "torchrl==0.14.1" "skrl==2.1.1" "openvino==2026.4.1" "wandb==0.31.0"
	$(CLIENTS)/bin/python -m pytest tests/clients tests/documents

clean: ## delete environments and built documentation
	rm -rf $(VENV) $(CLIENTS) docs/_build docs/_generated docs/reference/api docs/reference/mdp docs/results/policies

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "jumper-warp needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo missing). Try: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -c constraints.txt -e ".[dev]"
	@touch $@
