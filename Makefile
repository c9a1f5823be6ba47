# Two commands do all the set-up: `make train` and `make test`. Both need Python 3.11 and a package index, no more.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
RESULTS ?= results
ENGINE ?= engine=local

.PHONY: train test study vectorised initial tuned sensitivity wide why algorithms worlds longer ambiguities noise activations horizon learned tuning baselines policies report docs help notebooks layouts picture clean

train: .venv/.installed
	@echo "PPO with ReLU, 1,000,000 frames: a few minutes, as the bar tells"
	$(BIN)/uavnav train ppo activation=relu
	@echo "The commands above need: source .venv/bin/activate"

test: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy & $(BIN)/pytest -n 3 --dist worksteal -m "" && wait $$! # in parallel with the tests' first minute

.venv/.installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

.venv/.installed-dev: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ .venv/.installed

# Studies are files in uavnav/studies; what is finished is skipped, what is not goes on. ENGINE="engine=ray", say.
study: .venv/.installed
	$(BIN)/uavnav study paper out=$(RESULTS) $(ENGINE)

vectorised initial tuned sensitivity wide why algorithms worlds longer ambiguities noise activations horizon learned: .venv/.installed
	$(BIN)/uavnav study $@ out=$(RESULTS) report=false $(ENGINE)

tuning: .venv/.installed-dev # Optuna comes with what tests need
	$(BIN)/uavnav study tuning out=$(RESULTS) report=false $(ENGINE)

baselines: .venv/.installed # what needs no learning, on the test layouts
	$(BIN)/uavnav evaluate random straight reactive --out $(RESULTS)/baselines

policies: .venv/.installed # those that ship, chosen on the validation split among the committed runs
	$(BIN)/python -m uavnav.evaluation.choose $(RESULTS)

report: .venv/.installed # the report, docs/results.md and the findings in the README
	$(BIN)/uavnav report $(RESULTS)
	$(BIN)/python -m uavnav.report.docs $(RESULTS)

docs: .venv/.installed-dev # the site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

help: .venv/.installed # the help of each algorithm, and the tables of commands and settings in the docs
	$(BIN)/python -m uavnav.cli.help
	$(BIN)/python docs/tables.py

notebooks: .venv/.installed-dev # the outputs that are kept in them
	$(BIN)/python docs/outputs.py

layouts: .venv/.installed # the layouts that ship with the package, again
	$(BIN)/uavnav layouts --out uavnav/tasks/splits
	$(BIN)/uavnav layouts --task goal --out uavnav/tasks/splits

picture: .venv/.installed # the episodes and films in the README, the sensor and the learning curves of the docs
	$(BIN)/python docs/film.py dqn-tanh ppo-tanh reactive ppo-best
	$(BIN)/python docs/sensor.py
	$(BIN)/python docs/curves.py ppo dqn a2c c51 sac
	for film in drone:7 moving:20 goal:12 space:20 space-moving:20; do task=$${film%:*}; \
	  $(BIN)/uavnav train ppo preset=fast task=$$task evaluate=false out=runs/films/ppo-fast/$$task && \
	  $(BIN)/uavnav render runs/films/ppo-fast/$$task --greedy --layout $${film#*:} --steps 240 --every 4 --speed 2 \
	    --width 280 --out docs/films/$$task.gif || exit 1; done

clean:
	rm -rf .venv build *.egg-info
