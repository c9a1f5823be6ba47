# Two commands do all the set-up: `make train` and `make test`. Both need Python 3.11 and a package index, no more.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
SEEDS ?= 20
RESULTS ?= results
FOUR := activation=tanh,sigmoid,relu,leaky_relu
WIDE := activation=sigmoid,leaky_relu,elu,gelu,selu,silu,mish,softplus,softsign,identity

.PHONY: train test study one-world initial tuned sensitivity wide why baselines report docs help layouts picture clean

train: .venv/.installed
	$(BIN)/uavnav train ppo activation=relu

test: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2 --dist worksteal -m ""

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
	    $(BIN)/uavnav train $$algorithm -m $(FOUR) n_seeds=$(SEEDS) \
	        "out='$(RESULTS)/$$algorithm/\$${activation}'" || exit; \
	done

one-world: .venv/.installed # the study that answers for the paper: one world a seed, 40 seeds a cell
	$(foreach algorithm,ppo dqn,$(call cells,paper-one-world,$(algorithm),$(FOUR) preset=one-world n_seeds=40 seed=100))

# Small studies, each in a folder of its own. Those of SHORT are of 300,000 frames, with epsilon falling as in a million.
SHORT := total_frames=300000 evaluate=false
SHORT_dqn := exploration_fraction=0.33333333
PAIR := activation=tanh,relu
BOUNDED := activation=tanh,sigmoid

# $(call cells,FOLDER,ALGORITHM,SETTINGS): one cell an activation
define cells
	$(BIN)/uavnav train $(2) -m $(3) "out='$(RESULTS)/$(1)/$(2)/\$${activation}'"

endef
both = $(foreach algorithm,ppo dqn,$(call cells,$(1),$(algorithm),$(2) $(SHORT) $(SHORT_$(algorithm))))

initial: .venv/.installed # the first reward and eq. (14), for claim 10: 10 seeds, flown a little
	$(call both,baseline,$(PAIR) n_seeds=10)
	$(call both,initial,$(PAIR) n_seeds=10 reward=initial)
	$(BIN)/uavnav evaluate --episodes 10 --max-steps 500 $(foreach study,baseline initial,\
	    $(foreach algorithm,ppo dqn,$(foreach activation,tanh relu,$(RESULTS)/$(study)/$(algorithm)/$(activation))))

tuned: .venv/.installed # the presets `fast`
	$(foreach algorithm,ppo dqn,$(call cells,tuned,$(algorithm),$(BOUNDED) preset=fast n_seeds=5 seed=100))

sensitivity: .venv/.installed # one unsaid choice at a time, beside the baseline of `initial`
	$(foreach k,4 12,$(BIN)/uavnav layouts --split train --k $(k) --out $(RESULTS)/banks/$(k) && ) true
	$(foreach k,4 12,$(call both,obstacles-$(k),$(PAIR) n_seeds=5 layouts=$(RESULTS)/banks/$(k)/train.safetensors))
	$(call both,listed,$(PAIR) n_seeds=5 world.slots=listed)
	$(call both,zeros,$(PAIR) n_seeds=5 world.padding=zeros)
	$(call both,heading,$(PAIR) n_seeds=5 world.start_heading=random)
	$(call cells,starts,dqn,$(PAIR) n_seeds=5 learning_starts=100 $(SHORT) $(SHORT_dqn))
	$(call cells,init,ppo,$(PAIR) n_seeds=5 init=default $(SHORT))
	$(call cells,init,dqn,$(PAIR) n_seeds=5 init=orthogonal $(SHORT) $(SHORT_dqn))
	$(call both,one-world,$(PAIR) n_seeds=5 n_worlds=1)
	$(call cells,n-steps,dqn,$(PAIR) n_seeds=5 n_steps=5 $(SHORT) $(SHORT_dqn))
	$(BIN)/uavnav evaluate --episodes 10 --max-steps 500 $(foreach activation,tanh relu,\
	    $(RESULTS)/n-steps/dqn/$(activation))

wide: .venv/.installed # eight more activations, and two of the paper's, beside the baseline of `initial`
	$(call both,wide,$(WIDE) n_seeds=5)

# What explains the differences: each cell differs in one setting from the baseline of `initial`, 10 seeds, flown a little.
# $(call whys,NAME,ALGORITHM,SETTINGS)
define whys
	$(call cells,why/$(1),$(2),$(3) $(SHORT) $(SHORT_$(2)))
	$(BIN)/uavnav evaluate --episodes 10 --max-steps 500 $(RESULTS)/why/$(1)/$(2)/*

endef
both_whys = $(foreach algorithm,ppo dqn,$(call whys,$(1),$(algorithm),$(2)))
THREE := activation=tanh,sigmoid,relu
ALIKE := activation=hardtanh,relu6,sigmoid_centred n_seeds=10
MORE := activation=sigmoid,leaky_relu seed=5 n_seeds=5

why: .venv/.installed
	$(call both_whys,activations,$(ALIKE))
	$(call both_whys,more-seeds,$(MORE)) # the first five are those of `wide`
	$(call both_whys,layer-norm,$(THREE) n_seeds=10 layer_norm=true)
	$(call both_whys,unit,$(THREE) n_seeds=10 init=unit)
	$(foreach value,0.05 0.1 0.4 null,$(call whys,clip-$(value),ppo,n_seeds=10 clip_epsilon=$(value)))
	$(foreach value,1 3 20,$(call whys,epochs-$(value),ppo,n_seeds=10 epochs=$(value)))
	$(foreach value,0.9 0.95 0.999,$(call both_whys,gamma-$(value),n_seeds=10 gamma=$(value)))
	$(foreach value,0 0.01 0.2,$(call whys,epsilon-$(value),dqn,n_seeds=10 epsilon_end=$(value)))
	$(foreach value,0.001 0.01 0.03,$(call whys,entropy-$(value),ppo,n_seeds=10 entropy_coeff=$(value)))
	$(foreach algorithm,ppo dqn,$(foreach reward,initial additive,\
	    $(call cells,why/reward-$(reward),$(algorithm),$(PAIR) reward=$(reward) n_seeds=10)))

baselines: .venv/.installed # what needs no learning, on the test sets
	$(BIN)/uavnav evaluate random straight reactive --out $(RESULTS)/baselines

report: .venv/.installed # the report, docs/results.md and the findings in the README
	$(BIN)/uavnav report $(RESULTS)
	$(BIN)/python -m uavnav.report.docs $(RESULTS)

docs: .venv/.installed-dev # the site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

help: .venv/.installed # the help of each algorithm, from its configuration
	$(BIN)/python -m uavnav.help

layouts: .venv/.installed # the banks that ship with the package, again
	$(BIN)/uavnav layouts --out uavnav/tasks/banks

picture: .venv/.installed # the flights in the README, and the window in docs/start.md
	$(BIN)/uavnav render $(RESULTS)/ppo/relu $(RESULTS)/dqn/relu --layout 56 --steps 400 \
	    --every 4 --speed 4 --width 400 --out docs/flight.gif
	$(BIN)/python docs/window.py $(RESULTS)/ppo/relu $(RESULTS)/dqn/relu

clean:
	rm -rf .venv build *.egg-info
