# Everything starts from a bare checkout: set_up.py makes .venv and finds or installs OpenCL.
PYTHON ?= python3
SCENE ?= scenes/cornell_box.toml
OUT ?= out/$(basename $(notdir $(SCENE))).exr
ARGS ?=

RUN = .venv/bin/python -m

.PHONY: help render test test-slow lint setup clean

help:
	@echo "make render [SCENE=$(SCENE)] [OUT=$(OUT)] [ARGS='--spp 64']"
	@echo "make test [ARGS='-k film']   the fast tests"
	@echo "make test-slow              the slow ones"
	@echo "make lint                   ruff"
	@echo "make setup                  only make .venv and find or install OpenCL"
	@echo "make clean                  remove .venv, out and caches"

setup:
	@$(PYTHON) tools/set_up.py

render: setup
	@mkdir -p "$(dir $(OUT))"
	@$(RUN) psf_cl render "$(SCENE)" -o "$(OUT)" $(ARGS)

# Two processes: most of the time goes into compiling kernels, which one thread of a driver does.
test: setup
	@$(RUN) pytest -n 2 --dist loadfile $(ARGS)

test-slow: setup
	@$(RUN) pytest -m slow $(ARGS)

lint: setup
	@$(RUN) ruff check .

clean:
	rm -rf .venv out build *.egg-info .pytest_cache .ruff_cache
	find psf_cl cl tests tools -name __pycache__ -prune -exec rm -rf {} +
