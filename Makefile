# Two commands on a fresh machine: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.installed

.PHONY: demo test lint bench gallery gallery-elsewhere gallery-opacity gallery-tradeoff samples clean

demo: $(SETUP)
	mkdir -p out
	$(BIN)/volcli render configs/cloud.toml -o out/cloud.exr
	$(BIN)/volcli render configs/cloud.toml -o out/cloud.png --maps transmittance

# The second run has the kernels as plain Python, so that nothing rests on a quirk of the compiler.
test: $(SETUP) lint
	$(BIN)/python -m pytest -n 2 --dist loadfile
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -n 2 --dist loadfile -q -r f \
	    tests/test_kernels_cell.py tests/test_brick.py tests/test_render.py tests/test_render_extremes.py \
	    tests/test_emission.py tests/test_tint.py tests/test_crossing.py tests/test_plan.py \
	    tests/test_calibrate.py tests/test_tradeoff.py tests/test_extremes.py tests/test_properties.py \
	    tests/test_bounded_grids.py tests/test_bounded_rays.py tests/test_estimate_of_error.py

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

.PHONY: fuzz audit

# Damaged files, for a quarter of an hour.
fuzz: $(SETUP)
	$(BIN)/python -m fuzz --cases 20000

# What is known of the versions that are installed; needs a network.
audit: $(SETUP)
	$(PYTHON) -m venv build/audit
	build/audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
	build/audit/bin/pip-audit --skip-editable \
	    --path "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"

# Takes a quarter of an hour on an idle machine. Volumes are made by OpenVDB, beside whose vdb_render
# volcli is measured (Debian: python3-openvdb, libopenvdb-tools). Mitsuba compiles with an LLVM
# newer than 15 (tried: 22), which DRJIT_LIBLLVM_PATH can name, and otherwise runs without.
bench: $(SETUP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[bench]'
	$(BIN)/python -m benchmarks.accuracy
	$(BIN)/python -m pytest benchmarks/test_parts.py -q --benchmark-json benchmarks/results/parts.json
	$(BIN)/python -m benchmarks.calibrated
	$(BIN)/python -m benchmarks.startup
	$(BIN)/python -m benchmarks.inspect
	$(BIN)/python -m benchmarks.load
	$(BIN)/python -m benchmarks.render
	$(BIN)/python -m benchmarks.peers
	$(BIN)/python -m benchmarks.scaling
	$(BIN)/python -m benchmarks.memory
	$(BIN)/python -m benchmarks.batch
	$(BIN)/python -m benchmarks.report

# The README's pictures.
gallery: $(SETUP)
	mkdir -p docs/gallery
	$(BIN)/volcli render configs/cloud.toml -o docs/gallery/cloud.png --size 960x540 --maps transmittance
	$(BIN)/volcli render configs/explosion.toml -o docs/gallery/explosion.png --size 480x480 --set output.maps=[]
	$(BIN)/volcli render configs/fire.toml -o docs/gallery/fire.png --size 480x480
	$(BIN)/volcli render configs/temperature.toml -o docs/gallery/temperature.png --size 480x480
	$(BIN)/volcli render configs/colored_smoke.toml -o docs/gallery/colored_smoke.png --size 336x480 --set output.maps=[]
	$(BIN)/volcli render configs/rotated.toml -o docs/gallery/rotated.png --size 480x480 --set output.maps=[]
	$(BIN)/volcli render configs/panorama.toml -o docs/gallery/panorama.png --size 800x400 --set camera.samples=9
	$(BIN)/volcli batch configs/batch/turntable.toml --force --contact-sheet docs/gallery/turntable.png
	$(BIN)/python docs/strip_headers.py docs/gallery/*.png

# Pictures of volumes that are not ours, from a folder that has them: make gallery-elsewhere VOLUMES=...
gallery-elsewhere: $(SETUP)
	$(BIN)/volcli render configs/elsewhere/oiio_sphere_Cd.toml -o docs/gallery/oiio_sphere_Cd.png --size 480x480 \
	    --set density.file=$(VOLUMES)/oiio_sphere.vdb --set color.file=$(VOLUMES)/oiio_sphere_Cd.vdb
	$(BIN)/volcli render configs/elsewhere/density_and_heat.toml -o docs/gallery/density_and_heat.png \
	    --size 360x480 --set density.file=$(VOLUMES)/density_and_heat.vdb
	$(BIN)/python docs/strip_headers.py docs/gallery/*.png

# The README's pictures of opacity; that of the page needs a browser (Debian: apt-get install chromium).
VIEW := --color-grid Cd --density-scale 0.5 --size 720x540 --eye 0,1.9,8.6 --target 0,2.1,0
gallery-opacity: $(SETUP)
	mkdir -p out
	$(BIN)/volcli render samples/cloud.vdb $(VIEW) -o out/cloud.exr
	$(BIN)/volcli render samples/cloud.vdb $(VIEW) -o out/cloud-step6.exr --step 6
	$(BIN)/volcli inspect out/cloud.exr out/cloud-step6.exr --html out/page.html
	$(BIN)/python docs/page_picture.py out/page.html docs/page.png '#layer=opacity&wipe=0.5&line=1&iso=0.5'
	$(BIN)/volcli inspect out/cloud.exr --heatmap docs/heatmap.png --contours 0.2,0.5,0.8
	$(BIN)/volcli probe samples/explosion.vdb --density-scale 2 --color-grid Cd --pixel 400,300 \
	    --step 2 --step 8 --plot docs/probe.png
	$(BIN)/python docs/strip_headers.py docs/page.png docs/heatmap.png docs/probe.png

# The README's picture of speed against accuracy: on an idle machine, since times are what it shows.
gallery-tradeoff: $(SETUP)
	$(BIN)/volcli tradeoff configs/certified.toml -o out/tradeoff --size 640x360 --target-error 0.0039
	cp out/tradeoff/tradeoff.png docs/tradeoff.png

# Needs the real OpenVDB library (Debian: apt-get install python3-openvdb).
samples:
	/usr/bin/python3 samples/make_samples.py samples

$(SETUP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) out build *.egg-info .pytest_cache .ruff_cache .mypy_cache
