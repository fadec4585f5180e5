# Two commands do everything on a fresh machine, set-up included:
#   make demo   record the sample job twice and compare; show where two other runs diverge
#   make test   the tests: under five minutes on two quiet cores
# What takes longer has targets of its own (tests/README.md, campaigns/README.md):
#   make check         lint, types and import contracts
#   make test-all      the other tests: all cases of each kind, and what runs in real time
#   make truth         a thousand planted faults, and what diff says of them
#   make dist          wheel and sdist, tried in empty environments
#   make attack        hostile files, jobs, nodes, servers and disks, for an hour
# Needs Python 3.10 to 3.13 (with venv) on Linux x86_64, and nothing else.

PYTHON ?= python3
VENV ?= .venv
ROS ?= ros,dev-ros
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
OUT ?= out
SAMPLE := sample_traces/nondeterministic_callback

.PHONY: demo test check test-all test-long test-native test-kilted test-arm truth attack rclpy-tests rclcpp-tests lint types architecture compiled unit setup docs site docs-serve dist samples bench pictures clean

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' \
		|| { echo "rsltrace needs Python 3.10 to 3.13; set PYTHON=python3.12 or the like"; exit 1; }
	@echo "setting up $(VENV) (once, about a minute)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(ROS),view,remote,rerun,dev,docs]'
	@touch $@

demo: $(INSTALLED)
	@mkdir -p $(OUT)
	$(BIN)/rsltrace record examples/rslcpp_determinism/job.yaml -o $(OUT)/run1.mcap --force --quiet
	$(BIN)/rsltrace record examples/rslcpp_determinism/job.yaml -o $(OUT)/run2.mcap --force --quiet
	@cmp $(OUT)/run1.mcap $(OUT)/run2.mcap && echo "the two runs are identical, byte for byte"
	$(BIN)/rsltrace info $(OUT)/run1.mcap
	$(BIN)/rsltrace diff $(OUT)/run1.mcap $(OUT)/run2.mcap
	@echo; echo "and two runs of a robot with a bug:"; echo
	$(BIN)/rsltrace diff $(SAMPLE)/a.mcap $(SAMPLE)/b.mcap || test $$? -eq 1

test: unit

check: lint types architecture

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	$(BIN)/mypy

architecture: $(INSTALLED)
	$(BIN)/lint-imports

# The tests start hundreds of processes: none of them shall have to compile our modules again. The
# module in C is built where a compiler is.
unexport PYTHONDONTWRITEBYTECODE
compiled: $(INSTALLED)
	@$(BIN)/python -m compileall -q rsltrace viewer
	@$(BIN)/python hatch_build.py

unit: compiled
	$(BIN)/python -m pytest -n auto --dist worksteal $(PYTEST)

# What make test leaves out, and with many cases what tries few of them there (tests/README.md).
test-all: test-long test-native

test-long: compiled
	$(BIN)/python -m pytest -n auto --dist worksteal --many-cases -m '(long or repeated or hypothesis) and not native' $(PYTEST)

# Comparisons with rclpy's own executors over DDS, in real time: one at a time.
test-native: compiled
	$(BIN)/python -m pytest --many-cases -m native $(PYTEST)

# The standing attack (campaigns/attack); what gave way is kept in out/attack with the line that repeats
# it, beside the figures of the run: make attack ATTACK_MINUTES=5 ATTACK_SEED=1234
ATTACK_MINUTES ?= 60
ATTACK_SEED ?=
attack: compiled
	$(BIN)/python -m campaigns.attack --minutes $(ATTACK_MINUTES) $(if $(ATTACK_SEED),--seed $(ATTACK_SEED))

# Faults planted in random graphs, and an oracle that reads the traces with the mcap package alone
# (campaigns/truth); the table of classes is in out/truth/table.md: make truth TRUTH_FAULTS=200
TRUTH_FAULTS ?= 1000
truth: compiled
	$(BIN)/python -m campaigns.truth --faults $(TRUTH_FAULTS)

# rclpy's own tests on our middleware: make rclpy-tests RCLPY=path/to/a/checkout/of/rclpy
RCLPY ?=
rclpy-tests: $(INSTALLED)
	$(BIN)/python campaigns/rclpy_suite --rclpy $(RCLPY)

# rclcpp's own gtests, that you have built, natively and here: make rclcpp-tests PREFIX=folder/of/the/executables
PREFIX ?=
rclcpp-tests: $(INSTALLED)
	$(BIN)/python campaigns/gtests $(PREFIX)

# The tests that run nodes, on the next release of ROS 2, in an environment of its own.
KILTED := VENV=.venv-kilted ROS=ros-kilted,dev-ros-kilted
KILTED_TESTS ?=
test-kilted:
	@$(MAKE) --no-print-directory $(KILTED) unit PYTEST="$(KILTED_TESTS)"

# The examples on an emulated ARM machine, as root: same digests? make test-arm ARM_JOBS="cart ping_pong"
ARM_JOBS ?=
test-arm: $(INSTALLED)
	$(BIN)/python -m campaigns.arm $(ARM_JOBS)

# docs/jobs.md is made from the models of rsltrace.job, the manual pages in man/ from the commands, the
# drawings of docs/architecture.md and docs/concepts by scripts; a test fails when one is stale.
docs: $(INSTALLED)
	$(BIN)/python -m rsltrace.job.documents.reference > docs/jobs.md
	$(BIN)/python docs/make_man_pages.py
	$(BIN)/python docs/draw_architecture.py
	$(BIN)/python docs/draw_concepts.py

# The site: strict (which --quiet would undo), so a link that leads nowhere or a page that nobody can reach is an error.
# `make docs-serve` shows it at http://127.0.0.1:8000 while one writes.
MKDOCS := NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs
site: $(INSTALLED)
	$(MKDOCS) build --strict

docs-serve: $(INSTALLED)
	$(MKDOCS) serve

# A wheel and an sdist in dist/, installed where there is nothing else and tried there.
dist: $(INSTALLED)
	$(BIN)/python tests/packaging/check_dist.py dist

samples: $(INSTALLED)
	$(BIN)/python sample_traces/make_samples.py

bench: $(INSTALLED)
	$(BIN)/python benchmarks/throughput.py
	$(BIN)/python benchmarks/usual.py

# The pictures of the documentation, drawn without a screen (docs/draw_pictures.py says what they
# need); a test fails when one is stale.
pictures: $(INSTALLED)
	$(BIN)/python docs/draw_pictures.py

clean:
	rm -rf $(VENV) $(OUT)
