# Two commands on a fresh machine: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.installed

.PHONY: demo test lint bench gallery gallery-elsewhere samples clean

demo: $(SETUP)
	mkdir -p out
	$(BIN)/volcli render configs/cloud.toml -o out/cloud.exr
	$(BIN)/volcli render configs/cloud.toml -o out/cloud.png --maps transmittance

# The second run has the kernels as plain Python, so that nothing rests on a quirk of the compiler.
test: $(SETUP) lint
	$(BIN)/python -m pytest -n 2
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -n 2 -q -r f \
	    tests/test_kernels_cell.py tests/test_brick.py tests/test_render.py tests/test_render_extremes.py

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Takes a quarter of an hour on an idle machine. Volumes are made by OpenVDB, beside whose vdb_render
# volcli is measured (Debian: python3-openvdb, libopenvdb-tools). Mitsuba compiles with an LLVM
# newer than 15 (tried: 22), which DRJIT_LIBLLVM_PATH can name, and otherwise runs without.
bench: $(SETUP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[bench]'
	$(BIN)/python -m benchmarks.accuracy
	$(BIN)/python -m pytest benchmarks/test_parts.py -q --benchmark-json benchmarks/results/parts.json
	$(BIN)/python -m benchmarks.startup
	$(BIN)/python -m benchmarks.load
	$(BIN)/python -m benchmarks.render
	$(BIN)/python -m benchmarks.peers
	$(BIN)/python -m benchmarks.scaling
	$(BIN)/python -m benchmarks.report

# The README's pictures.
gallery: $(SETUP)
	mkdir -p docs/gallery
	$(BIN)/volcli render configs/cloud.toml -o docs/gallery/cloud.png --size 960x540 --maps transmittance
	$(BIN)/volcli render configs/explosion.toml -o docs/gallery/explosion.png --size 480x480 --set output.maps=[]
	$(BIN)/volcli render configs/colored_smoke.toml -o docs/gallery/colored_smoke.png --size 336x480 --set output.maps=[]
	$(BIN)/volcli render configs/rotated.toml -o docs/gallery/rotated.png --size 480x480 --set output.maps=[]
	$(BIN)/volcli render configs/panorama.toml -o docs/gallery/panorama.png --size 800x400 --set camera.samples=9
	$(BIN)/python docs/strip_headers.py docs/gallery/*.png

# Pictures of volumes that are not ours, from a folder that has them: make gallery-elsewhere VOLUMES=...
gallery-elsewhere: $(SETUP)
	$(BIN)/volcli render configs/elsewhere/oiio_sphere_Cd.toml -o docs/gallery/oiio_sphere_Cd.png --size 480x480 \
	    --set density.file=$(VOLUMES)/oiio_sphere.vdb --set color.file=$(VOLUMES)/oiio_sphere_Cd.vdb
	$(BIN)/python docs/strip_headers.py docs/gallery/*.png

# Needs the real OpenVDB library (Debian: apt-get install python3-openvdb).
samples:
	/usr/bin/python3 samples/make_samples.py samples

$(SETUP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) out build *.egg-info .pytest_cache .ruff_cache .mypy_cache
