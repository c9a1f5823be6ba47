# Two commands do all the set-up: `make train` and `make test`. Both need Python 3.11 and a package index, no more.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
SEEDS ?= 20
RESULTS ?= results

.PHONY: train test study layouts picture clean

train: .venv/.installed
	$(BIN)/python recipes/ppo.py activation=relu

test: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2 -m ""

.venv/.installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

.venv/.installed-dev: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ .venv/.installed

study: .venv/.installed # the paper's eight cells, cell by cell; what is finished is skipped, what is not goes on
	for algorithm in ppo dqn; do \
	    $(BIN)/python recipes/$$algorithm.py -m activation=tanh,sigmoid,relu,leaky_relu n_seeds=$(SEEDS) \
	        "out='$(RESULTS)/$$algorithm/\$${activation}'" || exit; \
	done

layouts: .venv/.installed # the banks that ship with the package, again
	$(BIN)/python -m uavnav.layouts --out uavnav/banks

picture: .venv/.installed # the flight in the README, from the run that `make train` left
	$(BIN)/python -m uavnav.render runs/ppo/relu --sampled --layout 20 --steps 400 --out docs/flight.gif

clean:
	rm -rf .venv build *.egg-info
