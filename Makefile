# Two commands are enough for a fresh machine with Python 3.11 or newer:
#   make demo    learn from the shipped recordings, compare the policies, open the replay
#   make test    lint, types, tests, examples; .ci/run adds the documentation, the package and the lowest versions
# Either makes .venv first if it is missing, and installs again when pyproject.toml has changed.

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	if command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; \
	then echo $$p; break; fi; done)
VENV := .venv
# the lowest versions that pyproject.toml allows are tested on the lowest Python that it allows
LOWEST_PYTHON ?= python3.11
LOWEST := .venv-lowest
# the Python that lerobot needs, and the environment in which it is tested
LEROBOT_PYTHON ?= python3.12
LEROBOT := .venv-lerobot
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# the tests start Python hundreds of times: without compiled files each start would read the library's source again
export PYTHONDONTWRITEBYTECODE :=
# two workers with one thread each: BLAS threads on these tiny matrices cost more than they bring
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest

# what touches other libraries: files in and out, robots, the command line; pytest refuses a missing file
QUICK := $(addprefix tests/test_,$(addsuffix .py,public_api cli controller mjcf loading playback meshes \
	linalg examples readers saved_files))

# what adds up many numbers: other processors' sums differ in the last bits, so these are run with an OpenBLAS kernel
# that is not this machine's (`make kernels`: with all of them). A name that this machine's OpenBLAS does not have (as on
# ARM) is another kernel or its own, with a warning
NUMERICAL := $(addprefix tests/test_,$(addsuffix .py,closed_loops constraint constraint_mechanism controller \
	features follow_motion free_direction gradients imposed law learning_parts limits linalg \
	mechanism motion native_engine pinned_answers cross_check robot tasks uncertainty velocities \
	witness))
KERNELS ?= Haswell Zen Prescott Nehalem Sandybridge
# which no processor of today chooses by itself: without AVX and FMA
OTHER_KERNEL ?= Prescott

.DEFAULT_GOAL := help
.PHONY: help demo test lint types check kernels fast lowest package dist wheels parts lerobot docs links bench fuzz proofs mutants vulnerabilities format \
	clean distclean

help:
	@sed -n '1,4s/^# \{0,1\}//p' Makefile
	@echo "Also: make lint, types, kernels, fast, format, docs, links, lowest, package, dist, wheels, parts, lerobot, bench, fuzz, proofs, mutants, vulnerabilities, clean, distclean"

# ---- installing -------------------------------------------------------------------------------------------------

$(VENV)/made:
	@if [ -z "$(PYTHON)" ]; then \
		echo "manip_learn needs Python 3.11 or newer and none was found; install it, or: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; \
		exit 1; fi
	$(PYTHON) -m venv $(VENV)
	@touch $@

# the linters alone: they read the code and need none of its dependencies
$(VENV)/lint: pyproject.toml $(VENV)/made
	$(BIN)/python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['optional-dependencies']['lint'], sep='\n')" > $@.txt
	$(PIP) install --quiet --requirement $@.txt
	@touch $@

$(VENV)/runtime: pyproject.toml $(VENV)/made
	$(PIP) install --quiet --editable '.[plan]'
	@touch $@

# the tests that need no other extra: 1.5 GB where dev has 3.4
$(VENV)/first: pyproject.toml $(VENV)/made
	$(PIP) install --quiet --editable '.[lint,robots,plan,test]'
	@touch $@ $(VENV)/runtime

# the compiled law, which the library can do without
$(VENV)/fast: $(wildcard fast/*.* fast/src/* fast/manip_learn_fast/*.py) $(VENV)/first
	@if command -v $(CXX) >/dev/null 2>&1; then $(PIP) install --quiet ./fast; else false; fi || \
		echo "THE COMPILED LAW COULD NOT BE BUILT (is there a C++17 compiler?): IT IS NOT TESTED" >&2
	@touch $@

$(VENV)/docs: pyproject.toml $(VENV)/made
	$(PIP) install --quiet --editable '.[docs]'
	@touch $@ $(VENV)/runtime

$(VENV)/dev: pyproject.toml $(VENV)/first
	$(PIP) install --quiet --editable '.[dev]'
	@touch $@ $(VENV)/docs

$(LOWEST)/made: pyproject.toml
	$(LOWEST_PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip --disable-pip-version-check install --quiet uv
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct --editable '.[all,test]'
	@touch $@

TELEOPERATOR := examples/lerobot_teleoperator_manip_learn
$(LEROBOT)/made: pyproject.toml $(TELEOPERATOR)/pyproject.toml
	$(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip --disable-pip-version-check install --quiet 'lerobot[dataset,feetech]>=0.6' \
		--editable '.[lerobot]' --editable $(TELEOPERATOR)
	@touch $@

# ---- doing ------------------------------------------------------------------------------------------------------

demo: $(VENV)/runtime
	$(BIN)/manip-learn demo $(ARGS)

test: lint types check

# the law in C++ in the place of the one in Python, wherever it is known
fast: $(VENV)/fast

lint: $(VENV)/lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/dev
	$(BIN)/pyright

# all tests with the compiled law where it could be built, the numerical ones as on another processor, and those of the
# law without it
check: $(VENV)/dev $(VENV)/fast
	$(PYTEST) -n 2 --dist worksteal --benchmark-disable $(addprefix --ignore=,$(NUMERICAL)) $(ARGS)
	OPENBLAS_CORETYPE=$(OTHER_KERNEL) $(PYTEST) -n 2 --dist worksteal --benchmark-disable -q $(NUMERICAL)
	MANIP_LEARN_ENGINE=python $(PYTEST) -n 2 --dist worksteal --benchmark-disable -q tests/test_law.py

# the numerical tests as on other processors
kernels: $(VENV)/dev $(VENV)/fast
	@for kernel in $(KERNELS); do export OPENBLAS_CORETYPE=$$kernel OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 && \
		$(BIN)/python -c "import numpy, scipy.linalg, threadpoolctl as t; \
		print('==', '$$kernel:', *{x.get('architecture') for x in t.threadpool_info()}, flush=True)" && \
		$(PYTEST) -n 2 --dist worksteal --benchmark-disable -q $(NUMERICAL) $(ARGS) || failed="$$failed $$kernel"; done; \
		test -z "$$failed" || { echo "NOT GREEN WITH$$failed" >&2; exit 1; }

format: $(VENV)/lint
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# the demo and the quick tests at the lowest versions
lowest: $(LOWEST)/made
	$(LOWEST)/bin/manip-learn demo --no-browser --out $(LOWEST)/demo
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest -n 2 --dist worksteal --benchmark-disable \
		-p no:cacheprovider -m 'not slow and not bench and not fuzz and not browser' $(QUICK) $(ARGS)

# wheel and sdist; the wheel's own demo, in an environment without extras and in a folder that holds nothing; then with
# extras a user's first hour: own arm, foreign recordings, a notebook (tests/first_hour)
package: $(VENV)/dev
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	@folder=$$(mktemp -d) && wheel=$$(ls "$$PWD"/dist/*.whl) && trap 'rm -rf "$$folder"' EXIT && \
	$(BIN)/python -m venv "$$folder/venv" && mkdir "$$folder/empty" && cd "$$folder/empty" && \
	"$$folder/venv/bin/python" -m zipfile --list "$$wheel" | grep -q 'licenses/LICENSES/Apache-2.0.txt' && \
	"$$folder/venv/bin/python" -m pip --disable-pip-version-check install --quiet "$$wheel" && \
	env -u PYTHONPATH "$$folder/venv/bin/manip-learn" demo --no-browser --json >"$$folder/demo.json" && \
	test -s demo_out/replay.html && echo "the wheel's own demo works" && \
	"$$folder/venv/bin/python" -m pip --disable-pip-version-check install --quiet --no-compile "$$wheel[robots,recordings,xacro]" \
		'nbclient>=0.10' 'ipykernel>=6.29' && \
	env -u PYTHONPATH "$$folder/venv/bin/python" "$(CURDIR)/tests/first_hour/hour.py" "$$folder/hour"

# both packages as a release has them, each built twice from nothing: the same commit gives the same bytes
dist: $(VENV)/dev
	rm -rf dist build/again && mkdir -p dist build/again
	export SOURCE_DATE_EPOCH=$$(git log -1 --pretty=%ct) PYTHONHASHSEED=0 && for out in dist build/again; do \
		$(BIN)/python -m build --outdir $$out . && $(BIN)/python -m build --outdir $$out fast || exit 1; done
	for file in dist/*; do cmp "$$file" "build/again/$$(basename "$$file")" || exit 1; done
	cd dist && sha256sum * >SHA256SUMS && cat SHA256SUMS

# a wheel of the compiled law for this machine, and the tests of the law with it; release.yml builds those of others
wheels: $(VENV)/dev
	rm -rf wheelhouse && $(BIN)/python -m build --wheel --outdir wheelhouse fast
	$(PIP) install --quiet --force-reinstall --no-deps wheelhouse/*.whl && touch $(VENV)/fast
	$(BIN)/python -P fast/try_it.py && $(PYTEST) --benchmark-disable tests/test_native_engine.py

# every package that an installation without extras brings, as CycloneDX
parts: $(VENV)/made
	$(PIP) install --quiet 'cyclonedx-bom>=7'
	rm -rf build/plain && $(BIN)/python -m venv build/plain && build/plain/bin/python -m pip install --quiet .
	mkdir -p dist && $(BIN)/cyclonedx-py environment build/plain/bin/python --pyproject pyproject.toml --of JSON -o dist/manip_learn.cdx.json

# driver and teleoperator against the real lerobot, with arms that are not there; its PyTorch makes that 6 GB
lerobot: $(LEROBOT)/made
	$(LEROBOT)/bin/python tests/with_lerobot/check.py

docs: $(VENV)/docs
	$(BIN)/sphinx-build -W --keep-going -b html docs docs/_build/html
	$(BIN)/python docs/check_pages.py docs/_build/html
	$(BIN)/python docs/list_figures.py
	@echo "docs/_build/html/index.html"

# links to other sites, which `make docs` does not follow: needs the network
links: $(VENV)/docs
	$(BIN)/sphinx-build -W --keep-going -b linkcheck docs docs/_build/links

# promises of speed, and no case slower than in the last release: the last tag, or BASE=REVISION
bench: $(VENV)/dev
	$(PYTEST) benchmarks -m bench $(ARGS)

fuzz: $(VENV)/dev
	HYPOTHESIS_PROFILE=fuzz $(PYTEST) -n 2 --benchmark-disable -m fuzz --timeout 1800 $(ARGS)

proofs: $(VENV)/dev
	CHECK_SHAPES=1 $(PYTEST) -n 2 --dist worksteal --benchmark-disable -m slow --timeout 3600 $(ARGS)

# faults that are put into copies of the library one by one: the tests must notice them. By default into the lines that
# changed since the last release; ARGS="manip_learn/linalg.py" into a file, ARGS="--draw 200" into all that computes.
# Which tests reach which line is noted first, in build/covered (20 minutes; `make clean` forgets it)
build/covered/seconds.json: $(VENV)/dev
	$(BIN)/python benchmarks/mutants.py --cover

mutants: build/covered/seconds.json
	$(BIN)/python benchmarks/mutants.py $(ARGS)

# known vulnerabilities of what is installed; asks the database of its index, so it needs the network
vulnerabilities: $(VENV)/dev
	$(PIP) install --quiet --editable '.[vulnerabilities]'
	$(BIN)/pip-audit --skip-editable

clean:
	rm -rf build dist out demo_out docs/_build .pytest_cache .ruff_cache .hypothesis .benchmarks
	find . -path './.venv*' -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV) $(LOWEST) $(LEROBOT)
