# make demo: all set-up, then the main job on a small scene.  make test: all set-up, then the tests.
# make docs: the documentation site, in build/docs.
# PYTHON names the interpreter where the one on the path does not do: make PYTHON=python3.12 test

BIN = .venv/bin
SOURCES = scripts/setup.sh requirements/lock.txt pyproject.toml

.PHONY: demo test lint docs setup clean

demo: .venv/base.done
	$(BIN)/spacesim demo --out out/demo

test: export PYTHONDONTWRITEBYTECODE = # byte code is kept: tests start the program a hundred times
test: .venv/test.done
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

lint: .venv/test.done
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

docs: .venv/docs.done
	$(BIN)/mkdocs build --strict

setup: .venv/test.done

.venv/base.done .venv/test.done .venv/docs.done: .venv/%.done: $(SOURCES)
	@PYTHON="$(PYTHON)" scripts/setup.sh $*
	@touch .venv/base.done $@

clean:
	rm -rf .venv out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
