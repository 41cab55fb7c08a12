# Everything installs into .venv, with the versions of requirements.lock and the digests that stand there.
PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(PYTHON) requirements.py install
# Half of the build of llama.cpp is tools that nothing here uses. Without GGML_NATIVE one wheel runs on any
# x86-64 of the last ten years; SOURCE_DATE_EPOCH would take AVX2 from it as well.
LLAMA_CPP := env -u SOURCE_DATE_EPOCH CMAKE_ARGS="-DMTMD_VIDEO=OFF -DGGML_NATIVE=OFF \
	-DCMAKE_PROJECT_llama.cpp_INCLUDE=$(CURDIR)/llama-cpp.cmake"
# pip keeps the wheels that it built, whatever they were built with: an older one may read no pictures.
SEES := $(BIN)/python -c "import llama_cpp.mtmd_cpp" 2>/dev/null || $(LLAMA_CPP) \
	$(PYTHON) requirements.py rebuild llama-cpp-python $(BIN)/python

# What `make real` asks a published model, and on how many layouts.
REAL_PROMPT ?= v10
REAL_LIMIT ?= 5

.PHONY: eval real results quick test exhaustive core check light browser docs bench release clean

eval: .venv/base ## a rule at once; then build llama.cpp, and evaluate the default language model with a report
	$(BIN)/harness eval --model proxy
	$(MAKE) --no-print-directory .venv/llama-cpp
	$(BIN)/harness eval --model swarm-tiny --prompt v2

real: .venv/dev ## fetch a published model, SmolLM2 with 135 million weights, and evaluate it with a report
	$(BIN)/harness model pull smollm2-135m
	$(BIN)/harness eval --model smollm2-135m --prompt $(REAL_PROMPT) --limit $(REAL_LIMIT)

results: .venv/dev ## docs/results.md and its picture: hours on a CPU; RESULTS="--limit 20" asks published models less
	$(BIN)/harness model pull smollm2-135m
	$(BIN)/python benchmarks/results.py --page docs/results.md --details benchmarks/measured/results.md \
	  --picture docs/pictures/results.svg $(RESULTS)

# Two workers; a test over its tier's limit of CPU seconds fails: CONTRIBUTING.md, "A cheap test".
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal

quick: .venv/dev ## nine tests of ten in a minute: neither slow nor exhaustive, nor of extensions that stayed
	$(PYTEST) --changed -m "not slow and not exhaustive" --hypothesis-profile quick --cpu-limit 0.5

test: check browser ## every check, and every test that is not exhaustive
	$(PYTEST) -m "not exhaustive" --cpu-limit 6

# The last share has the tests where no engine is installed, too, and the one before the core's without extensions.
exhaustive: .venv/dev browser ## the tests that `make test` leaves out; SHARE=K runs the K-th tenth of them, from 0 to 9
	$(PYTEST) -m exhaustive --cpu-limit 6 $(if $(SHARE),--share $(SHARE))
	$(if $(filter-out 8,$(SHARE)),,$(MAKE) --no-print-directory core)
	$(if $(filter-out 9,$(SHARE)),,$(MAKE) --no-print-directory light)

core: .venv/dev ## the core's own quick tests, in a copy without harness/extensions
	rm -rf build/core && mkdir -p build/core
	git ls-files -z | tar --create --null --files-from=- | tar --extract --directory build/core
	rm -rf build/core/harness/extensions build/core/tests/extensions
	cd build/core && PYTHONPATH=$(CURDIR)/build/core $(CURDIR)/$(PYTEST) -m "not slow and not exhaustive" \
	  --hypothesis-profile quick

light: .venv-light/test ## the tests without torch, llama.cpp and a browser, or ONLY some: what needs one is skipped
	.venv-light/bin/python -m pytest -n 2 --dist worksteal -m "not exhaustive" $(ONLY)

browser: ## Debian's chromium for the tests that open pages, which are skipped where there is none
	@command -v chromium >/dev/null || (apt-get update --quiet=2 && apt-get install --quiet=2 --yes \
		--no-install-recommends chromium fonts-dejavu-core >/dev/null) || \
		echo "no chromium, and apt-get cannot install it: tests that open pages are skipped"

check: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python readable.py
	$(BIN)/codespell

docs: .venv/docs ## the documentation as a site: build/docs/index.html
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --nitpicky docs build/docs

bench: .venv/dev ## the table of benchmarks/README.md, in some 25 minutes
	$(BIN)/python benchmarks/table.py --page benchmarks/README.md

release: .venv-release/tools ## wheel, sdist, locked list and licences in dist/, tried; PYTHONS="python3.11 python3.13"
	.venv-release/bin/python release.py $(PYTHONS)

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/base: .venv/bin/python pyproject.toml requirements.lock
	$(INSTALL) base $(BIN)/python --no-compile
	touch $@

.venv/llama-cpp: .venv/base
	$(LLAMA_CPP) $(INSTALL) llama-cpp $(BIN)/python
	$(SEES)
	touch $@

.venv/docs: .venv/bin/python pyproject.toml requirements.lock
	$(INSTALL) docs $(BIN)/python
	touch $@

.venv/dev: .venv/bin/python pyproject.toml requirements.lock
	$(LLAMA_CPP) $(INSTALL) dev $(BIN)/python
	$(SEES)
	touch .venv/base .venv/llama-cpp .venv/docs $@

.venv-light/test: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv-light
	$(INSTALL) test .venv-light/bin/python --no-compile
	touch $@

.venv-release/tools: release.lock
	$(PYTHON) -m venv .venv-release
	.venv-release/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps \
	  --requirement release.lock
	touch $@

clean:
	rm -rf .venv .venv-light .venv-release build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
