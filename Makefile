# The commands of the project. Each sets up what it needs through scripts/env, which says
# beforehand what it installs, where, and how long that takes.

ENV := scripts/env
OUT := out/demo
# On all cores, a file at a time to each: what the tests of a file share is made once.
PYTEST := python -m pytest -n logical --maxprocesses 8 --dist loadfile

# What benchmarks and scripts call is there, with those arguments; how precise their own types are
# is left to them.
LOOSE := $(addprefix --disable-error-code=,arg-type assignment misc no-any-return no-untyped-call \
  operator return-value type-arg union-attr unused-ignore var-annotated)

.DEFAULT_GOAL := help
.PHONY: help demo docs dist lattices test lint test-next bench shipped clean

help: ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## /\1|/p' $(MAKEFILE_LIST) | \
	  while IFS='|' read -r name what; do printf '  make %-10s %s\n' "$$name" "$$what"; done

demo: ## Reproduce the paper's virtual experiment in out/demo (open report.html)
	$(ENV) modeharvest run paper-virtual --out $(OUT)

docs: ## Build the documentation in docs/_build/html (minutes; the gallery's examples are run)
	$(ENV) python -m sphinx -b html -W --keep-going -j 2 docs docs/_build/html

dist: docs ## Make what a release consists of in dist: wheel, source archive, documentation
	rm -rf dist build src/*.egg-info
	$(ENV) python -m build --no-isolation --outdir dist .
	rm -rf build src/*.egg-info
	name=modeharvest-$$($(ENV) modeharvest --version)-docs && \
	  tar -C docs/_build -czf dist/$$name.tar.gz --transform "s/^html/$$name/" html

lattices: ## Analyse the infinite lattices that are shipped in out/lattices (minutes)
	for case in square-lattice hexagonal-lattice chiral-lattice mode-study; do \
	  $(ENV) modeharvest modes $$case --out out/lattices/$$case || exit; done

test: lint ## Lint, type-check and run the tests: all that must pass before a commit
	-scripts/browser
	$(ENV) $(PYTEST)

lint: ## Check style, types and the direction of imports
	$(ENV) ruff check .
	$(ENV) ruff format --check .
	$(ENV) mypy -p modeharvest
	$(ENV) env MYPYPATH=src:benchmarks:tests mypy --cache-dir .mypy_cache/programs \
	  $(LOOSE) benchmarks/*.py scripts/*.py
	$(ENV) env MYPYPATH=src:examples mypy --cache-dir .mypy_cache/examples \
	  --allow-untyped-defs --allow-incomplete-defs --allow-untyped-calls \
	  examples/*.py examples/gallery/*.py
	$(ENV) lint-imports

test-next: ## Run the tests on the next dolfinx (Debian unstable, in a root of its own)
	$(ENV) --next $(PYTEST)

bench: ## Run every program in benchmarks/ (hours; ratios within one run are what counts)
	for program in benchmarks/*.py; do $(ENV) python $$program || exit; done

peers: ## Measure beside riley-raster and pyxel-dic, in an environment of their own (15 min)
	benchmarks/peers/run

shipped: ## Make the solution anew that ships with the package
	$(ENV) modeharvest fem paper-virtual --out out/shipped
	cp out/shipped/solution.h5 src/modeharvest/cases/paper-virtual.h5

clean: ## Remove what the other commands leave in this folder (not the cache, not out/)
	rm -rf build dist src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis \
	  .import_linter_cache .benchmarks docs/_build docs/generated
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
