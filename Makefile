# make demo   the open-loop jump, 200 vertical and 200 horizontal jumps of the shipped policies, and one jump with a film:
#             metrics, plots, pictures and recordings in outputs/demo, in about a minute
# make test   all tests, and the import rules
# make clients  tests/clients with TorchRL, skrl, OpenVINO and W&B too, which it installs into .venv-clients
# make docs   the documentation site in docs/_build/html; a warning, such as a link without target, is an error
# make lint   style, format, words, import rules and types
# Each makes .venv/ first if it is missing or older than pyproject.toml or constraints.txt.

PYTHON ?= python3
VENV := .venv
CLIENTS := .venv-clients
STAMP := $(VENV)/.installed

.PHONY: demo test clients docs lint clean
.DELETE_ON_ERROR:

demo: $(STAMP)
	$(VENV)/bin/python experiments/demo.py --out outputs/demo

test: $(STAMP)
	$(VENV)/bin/lint-imports --no-logo
	$(VENV)/bin/python -m pytest --numprocesses auto --dist loadfile

clients:
	$(PYTHON) -m venv $(CLIENTS)
	$(CLIENTS)/bin/python -m pip install -c constraints.txt -e ".[dev]"
	$(CLIENTS)/bin/python -m pip install "torchrl==0.14.1" "skrl==2.1.1" "openvino==2026.4.1" "wandb==0.31.0"
	$(CLIENTS)/bin/python -m pytest tests/clients

docs: $(STAMP)
	$(VENV)/bin/python -m sphinx -b html -q -W --keep-going -j 2 docs docs/_build/html
	@echo "open docs/_build/html/index.html"

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pre-commit run --all-files words
	$(VENV)/bin/lint-imports --no-logo
	$(VENV)/bin/basedpyright --pythonpath $(VENV)/bin/python

clean:
	rm -rf $(VENV) $(CLIENTS) docs/_build docs/_generated docs/reference/api docs/results/policies

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "jumper-warp needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo missing). Try: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -c constraints.txt -e ".[dev]"
	@touch $@
