"use strict";
// Draws what is in view, a canvas's pixel at a time, from planes of numbers; a plane is unpacked as
// opacity/page.py packed it. All that the user can choose is in `state`, which the link keeps.

const data = JSON.parse(document.getElementById("data").textContent);
document.getElementById("data").remove();
const $ = (id) => document.getElementById(id);
const canvas = $("canvas"), context = canvas.getContext("2d", { alpha: false });
const { width, height } = data;
const LAYERS = [["picture", "Picture"], ["opacity", "Opacity"], ["transmittance", "Transmittance"],
  ["optical_depth", "Optical depth"], ["depth", "Depth"]];
const DECADES = 6; // of a logarithmic scale
const BINS = 128;
const state = {
  layer: "picture", left: 0, right: 1, wipe: 0.5, background: "checks", colour: "3878b3",
  colormap: Object.keys(data.colormaps)[0], log: 0, low: 0, high: 1, line: 0, iso: 0.5,
  from: null, to: null, zoom: null, x: width / 2, y: height / 2, theme: "",
};
let cursor = null; // [x, y] of a pixel

// -- data ---------------------------------------------------------------------------------------

function bytesOf(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function unpack(text, size) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const deltas = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = deltas.length / size, bytes = new Uint8Array(deltas.length);
  let value = 0;
  for (let k = 0, at = 0; k < size; k++) {
    for (let i = k; i < deltas.length; i += size) bytes[i] = value = (value + deltas[at++]) & 255;
  }
  if (count !== width * height) throw new Error("the data of this page is damaged");
  return size === 4 ? new Float32Array(bytes.buffer) : new Uint16Array(bytes.buffer);
}

const HALF = new Float32Array(65536); // the value of each float16
for (let bits = 0; bits < 65536; bits++) {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023;
  const size = exponent === 0 ? fraction * 2 ** -24
    : exponent === 31 ? (fraction ? NaN : Infinity) : (1 + fraction / 1024) * 2 ** (exponent - 15);
  HALF[bits] = bits & 32768 ? -size : size;
}
const SRGB = new Uint8Array(4097); // linear light in 4096 steps, as it is shown
for (let i = 0; i <= 4096; i++) {
  const v = i / 4096;
  SRGB[i] = Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
}
const linear = (code) => {
  const s = code / 255;
  return s <= 0.04045 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4;
};

async function load(image) {
  for (const [name, text] of Object.entries(image.planes)) {
    const size = ["red", "green", "blue"].includes(name) ? 2 : 4;
    image.planes[name] = await unpack(text, size);
  }
  if (image.planes.transmittance) return;
  const tau = image.planes.optical_depth;
  const transmittance = image.planes.transmittance = new Float32Array(tau.length);
  for (let i = 0; i < tau.length; i++) transmittance[i] = Math.exp(-tau[i]);
}

// A plane of an image by its name; null where it has none. Opacity is worked out when it is wanted.
function plane(image, name) {
  if (name === "opacity" && !image.planes.opacity) {
    const tau = image.planes.optical_depth, values = new Float32Array(tau.length);
    for (let i = 0; i < tau.length; i++) values[i] = -Math.expm1(-tau[i]);
    image.planes.opacity = values;
  }
  return image.planes[name] || null;
}

const left = () => data.images[state.left], right = () => data.images[state.right] || left();
// The layer of which range, histogram and highlight are: of the picture it is opacity.
const measured = () => (state.layer === "picture" ? "opacity" : state.layer);

const extremes = new Map();
function ends(name) { // the smallest, the smallest above 0 and the largest finite value
  const key = [name, state.left, state.right].join();
  if (extremes.has(key)) return extremes.get(key);
  let low = Infinity, positive = Infinity, high = -Infinity;
  for (const image of new Set([left(), right()])) {
    const values = plane(image, name);
    for (let i = 0; values && i < values.length; i++) {
      const v = values[i];
      if (v < low) low = v;
      if (v > 0 && v < positive) positive = v;
      if (v > high && v < Infinity) high = v;
    }
  }
  if (!(high >= low)) [low, high] = [0, 1];
  if (!(positive <= high)) positive = high > 0 ? high : 1e-6;
  const found = { low, positive: Math.max(positive, high / 10 ** DECADES), high };
  if (name === "opacity" || name === "transmittance") {
    if (high - low > 0.5) [found.low, found.high] = [0, 1];
    else if (name === "opacity") found.low = 0;
  } else if (name === "optical_depth") found.low = 0;
  if (found.high <= found.low) found.high = found.low + 1;
  extremes.set(key, found);
  return found;
}

// A share (0 to 1) of the range of a layer as a value, and a value as a share.
function valueAt(share, name) {
  const { low, positive, high } = ends(name);
  if (!state.log) return low + share * (high - low);
  return positive * (high / positive) ** share;
}
function shareOf(value, name) {
  const { low, positive, high } = ends(name);
  if (!state.log) return (value - low) / (high - low);
  return Math.log(value / positive) / Math.log(high / positive) || 0;
}

// -- drawing ------------------------------------------------------------------------------------

function opaque(r, g, b) { return (0xff000000 | (b << 16) | (g << 8) | r) >>> 0; }
const GREY = opaque(128, 128, 128);

function lookup() {
  const bytes = bytesOf(data.colormaps[state.colormap]), table = new Uint32Array(256);
  for (let i = 0; i < 256; i++) table[i] = opaque(bytes[3 * i], bytes[3 * i + 1], bytes[3 * i + 2]);
  return table;
}

// A function that paints a part of a row: pixel row + columns[x] at x, from x0 up to x1, into out.
function painter(image) {
  if (state.layer === "picture") return picturePainter(image);
  const values = plane(image, state.layer), table = lookup();
  if (!values) return (out, at, row, columns, x0, x1) => out.fill(GREY, at + x0, at + x1);
  let low = valueAt(state.low, state.layer), high = valueAt(state.high, state.layer);
  const log = Boolean(state.log);
  if (log) [low, high] = [Math.log(low), Math.log(high)];
  const scale = 255.999 / Math.max(high - low, 1e-30);
  return (out, at, row, columns, x0, x1) => {
    for (let x = x0; x < x1; x++) {
      const value = values[row + columns[x]], v = log ? Math.log(value) : value;
      const shade = (v - low) * scale;
      // Grey: NaN, no hit, 0 on a logarithmic scale.
      out[at + x] = !(v < Infinity && v > -Infinity) ? GREY
        : table[shade <= 0 ? 0 : shade >= 255 ? 255 : shade | 0];
    }
  };
}

function shown(v) { return SRGB[v <= 0 ? 0 : v >= 1 ? 4096 : (v * 4096 + 0.5) | 0]; }

function picturePainter(image) {
  const { red, green, blue, transmittance } = image.planes;
  const throughs = ["red", "green", "blue"].map((c) => image.planes[`through_${c}`] || transmittance);
  const [throughRed, throughGreen, throughBlue] = throughs;
  const code = state.background === "custom" ? state.colour : state.background;
  const checks = state.background === "checks";
  const [r, g, b] = [0, 2, 4].map((at) => linear(parseInt(code.slice(at, at + 2), 16)));
  const dark = linear(110), light = linear(150);
  return (out, at, row, columns, x0, x1, y) => {
    for (let x = x0; x < x1; x++) {
      const i = row + columns[x], board = ((x >> 4) ^ (y >> 4)) & 1 ? light : dark;
      let R = throughRed[i] * (checks ? board : r), G = throughGreen[i] * (checks ? board : g);
      let B = throughBlue[i] * (checks ? board : b);
      if (red !== undefined) { R += HALF[red[i]]; G += HALF[green[i]]; B += HALF[blue[i]]; }
      out[at + x] = opaque(shown(R), shown(G), shown(B));
    }
  };
}

function fitZoom() { return Math.min(canvas.width / width, canvas.height / height); }
function zoom() { return state.zoom === null ? fitZoom() : state.zoom * devicePixelRatio; }

// Image columns (or rows) of the canvas's; -1 outside.
function sources(count, size, centre) {
  const at = new Int32Array(count), z = zoom();
  for (let i = 0; i < count; i++) {
    const p = Math.floor((i + 0.5 - count / 2) / z + centre);
    at[i] = p >= 0 && p < size ? p : -1;
  }
  return at;
}

function draw() {
  const begin = performance.now();
  const W = canvas.width, H = canvas.height, frame = context.createImageData(W, H);
  const out = new Uint32Array(frame.data.buffer);
  const columns = sources(W, width, state.x), rows = sources(H, height, state.y);
  const outside = getComputedStyle($("stage")).backgroundColor.match(/\d+/g).map(Number);
  out.fill(opaque(...outside));
  const first = columns.findIndex((c) => c >= 0), last = columns.findLastIndex((c) => c >= 0) + 1;
  const split = data.images.length > 1 ? Math.round(state.wipe * W) : W;
  const sides = first < 0 ? [] : [
    [left(), first, Math.min(last, split)], [right(), Math.max(first, split), last],
  ];
  for (const [image, x0, x1] of sides) {
    if (x0 >= x1) continue;
    const paint = painter(image);
    for (let y = 0; y < H; y++) {
      if (rows[y] >= 0) paint(out, y * W, rows[y] * width, columns, x0, x1, y);
    }
    if (state.from !== null) dimOthers(image, out, W, rows, columns, x0, x1);
    if (state.line) drawLine(image, out, W, rows, columns, x0, x1);
  }
  if (data.images.length > 1) {
    const x = Math.max(1, Math.min(split, W - 1));
    for (let y = 0; y < H; y++) {
      out[y * W + x - 1] = opaque(0, 0, 0);
      out[y * W + x] = opaque(255, 255, 255);
    }
  }
  context.putImageData(frame, 0, 0);
  placeCross();
  canvas.dataset.drawMs = (performance.now() - begin).toFixed(1);
}

// Darken what is not highlighted.
function dimOthers(image, out, W, rows, columns, x0, x1) {
  const values = plane(image, measured()), { from, to } = state;
  for (let y = 0; y < rows.length; y++) {
    if (rows[y] < 0) continue;
    for (let x = x0, at = y * W + x0, row = rows[y] * width; x < x1; x++, at++) {
      const v = values === null ? NaN : values[row + columns[x]];
      if (!(v >= from && v <= to)) out[at] = (0xff000000 | (((out[at] & 0xfcfcfc) >> 2) + 0x303030)) >>> 0;
    }
  }
}

// Where opacity crosses the chosen one between a pixel of the canvas and that above or to the left.
function drawLine(image, out, W, rows, columns, x0, x1) {
  const opacity = plane(image, "opacity"), threshold = state.iso;
  let above = new Uint8Array(W).fill(2), here = new Uint8Array(W); // 0 or 1; 2: there is no row
  for (let y = 0; y < rows.length; y++) {
    if (rows[y] < 0) continue;
    for (let x = x0, at = y * W + x0, row = rows[y] * width; x < x1; x++, at++) {
      const over = here[x] = opacity[row + columns[x]] >= threshold ? 1 : 0;
      if (above[x] + over === 1 || (x > x0 && here[x - 1] !== over)) {
        out[at] = ((out[at] >> 8) & 255) > 110 ? opaque(0, 0, 0) : opaque(255, 255, 255);
      }
    }
    [above, here] = [here, above];
  }
}

let waiting = false;
function refresh() { // once a frame, however often the state changes
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    showState();
    drawHistogram();
    drawBrushed();
    drawValues();
    draw();
    keep();
  });
}

// -- histogram and colour bar -------------------------------------------------------------------

const counted = new Map();
function counts(name) {
  const key = [name, state.left, state.log].join();
  if (counted.has(key)) return counted.get(key);
  const values = plane(left(), name), opacity = plane(left(), "opacity");
  const bins = new Uint32Array(BINS);
  for (let i = 0; values && i < values.length; i++) {
    if (!(opacity[i] > 0) || !(values[i] < Infinity)) continue; // of what is visible
    const at = Math.floor(shareOf(values[i], name) * BINS);
    if (at >= 0 && at <= BINS) bins[Math.min(at, BINS - 1)]++;
  }
  counted.set(key, bins);
  return bins;
}

function sized(element) {
  const wanted = Math.round(element.clientWidth * devicePixelRatio);
  const tall = Math.round(element.clientHeight * devicePixelRatio);
  if (element.width !== wanted || element.height !== tall) {
    element.width = wanted;
    element.height = tall;
  }
  return [element.getContext("2d"), element.width, element.height];
}

function drawHistogram() {
  const name = measured(), bins = counts(name), table = lookup();
  const [ink, W, H] = sized($("histogram"));
  const style = getComputedStyle(document.documentElement);
  const most = Math.sqrt(Math.max(1, ...bins));
  ink.fillStyle = style.getPropertyValue("--stage");
  ink.fillRect(0, 0, W, H);
  const low = state.low, high = state.high;
  for (let k = 0; k < BINS; k++) {
    const tall = bins[k] && Math.max(1, (Math.sqrt(bins[k]) / most) * (H - 2)); // roots: rare shows
    const at = Math.max(0, Math.min(255, Math.round(((k + 0.5) / BINS - low) / (high - low) * 255)));
    const c = state.layer === "picture" ? null : table[at];
    ink.fillStyle = c === null ? style.getPropertyValue("--faint")
      : `rgb(${c & 255},${(c >> 8) & 255},${(c >> 16) & 255})`;
    ink.fillRect((k / BINS) * W, H - tall, W / BINS + 0.5, tall);
  }
  if (state.from !== null) {
    const a = shareOf(state.from, name) * W, b = shareOf(state.to, name) * W;
    ink.strokeStyle = style.getPropertyValue("--accent");
    ink.lineWidth = 3;
    ink.strokeRect(a, 1.5, Math.max(b - a, 2), H - 3);
  }
  $("least").textContent = show(valueAt(0, name));
  $("most").textContent = show(valueAt(1, name));
  const whose = data.images.length > 1 ? ", left image" : "";
  $("histogram-title").textContent = `Histogram of ${titleOf(name).toLowerCase()}${whose}`;
  const [bar, across, tall] = sized($("bar"));
  for (let x = 0; x < across; x++) {
    const at = (x / across - low) / (high - low) * 255;
    const c = table[Math.max(0, Math.min(255, Math.round(at)))];
    bar.fillStyle = `rgb(${c & 255},${(c >> 8) & 255},${(c >> 16) & 255})`;
    bar.fillRect(x, 0, 1, tall);
  }
}

function drawBrushed() {
  const name = measured();
  for (const id of ["from", "to"]) {
    if (document.activeElement !== $(id)) {
      $(id).value = state[id] === null ? "" : Number(state[id].toPrecision(6));
    }
  }
  if (state.from === null) {
    $("brushed").textContent = $("brushed").dataset.key = "";
    return;
  }
  const key = [name, state.left, state.from, state.to].join();
  if ($("brushed").dataset.key === key) return;
  const values = plane(left(), name);
  let n = 0;
  for (let i = 0; values && i < values.length; i++) {
    if (values[i] >= state.from && values[i] <= state.to) n++;
  }
  const share = ((100 * n) / (width * height)).toPrecision(3);
  $("brushed").textContent = `${n.toLocaleString("en")} pixels, ${share} %`;
  $("brushed").dataset.key = key;
}

// -- values under the cursor --------------------------------------------------------------------

const titleOf = (name) => LAYERS.find(([n]) => n === name)[1];
function show(v) {
  if (v === null || v === undefined) return "-";
  if (!Number.isFinite(v)) return Number.isNaN(v) ? "NaN" : v > 0 ? "infinite" : "-infinite";
  const small = v !== 0 && Math.abs(v) < 1e-3;
  return small ? v.toExponential(5).replace(/\.?0*e/, "e") : String(Number(v.toPrecision(6)));
}

function drawValues() {
  const heads = ["", "Opacity", "Transmittance", "Optical depth", "Depth", "Red, green, blue"];
  $("heads").replaceChildren(...heads.map((text) => cell("th", text)));
  $("where").textContent = cursor ? `x ${cursor[0]}, y ${cursor[1]}` : "nothing";
  const images = data.images.length > 1 ? [left(), right()] : [left()];
  $("rows").replaceChildren(...images.map((image, side) => {
    const row = document.createElement("tr");
    const label = images.length > 1 ? `${["left", "right"][side]}: ${image.name}` : "";
    row.append(cell("th", label), ...valuesOf(image).map((text) => cell("td", text)));
    return row;
  }));
}

function valuesOf(image) {
  if (!cursor) return ["-", "-", "-", "-", "-"];
  const i = cursor[1] * width + cursor[0], { planes } = image;
  const rgb = ["red", "green", "blue"].map((n) => planes[n] && HALF[planes[n][i]]);
  return [
    show(plane(image, "opacity")[i]), show(planes.transmittance[i]), show(planes.optical_depth[i]), planes.depth ? show(planes.depth[i]) : "-",
    planes.red ? rgb.map((v) => Number(v.toPrecision(3))).join(", ") : "-",
  ];
}

function cell(kind, text) {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}

function placeCross() {
  const cross = $("cross"), z = zoom() / devicePixelRatio;
  cross.hidden = !cursor || document.activeElement !== canvas;
  if (cross.hidden) return;
  const size = Math.max(6, z);
  const x = canvas.clientWidth / 2 + (cursor[0] + 0.5 - state.x) * z - size / 2;
  const y = canvas.clientHeight / 2 + (cursor[1] + 0.5 - state.y) * z - size / 2;
  Object.assign(cross.style, { left: `${x}px`, top: `${y}px`, width: `${size}px`, height: `${size}px` });
}

function pixelAt(event) {
  const box = canvas.getBoundingClientRect(), z = zoom() / devicePixelRatio;
  const x = Math.floor((event.clientX - box.left - box.width / 2) / z + state.x);
  const y = Math.floor((event.clientY - box.top - box.height / 2) / z + state.y);
  return x >= 0 && y >= 0 && x < width && y < height ? [x, y] : null;
}

// -- the state, the controls and the link -------------------------------------------------------

function update(changes) {
  const before = measured(), { log } = state;
  Object.assign(state, changes);
  if (measured() !== before) Object.assign(state, { low: 0, high: 1, from: null, to: null });
  if (state.log !== log) Object.assign(state, { low: 0, high: 1 });
  if (state.low >= state.high) {
    if ("low" in changes) state.high = Math.min(1, state.low + 0.001);
    state.low = Math.min(state.low, state.high - 0.001);
  }
  refresh();
}

function showState() {
  for (const [name] of LAYERS) {
    const button = $(`layer-${name}`);
    if (button) button.checked = state.layer === name;
  }
  for (const id of ["left", "right", "wipe", "background", "colormap", "low", "high", "iso"]) {
    if (String($(id).value) !== String(state[id])) $(id).value = state[id];
  }
  $("colour").value = `#${state.colour}`;
  $("log").checked = Boolean(state.log);
  $("line").checked = Boolean(state.line);
  $("behind").disabled = state.layer !== "picture";
  $("scale").disabled = state.layer === "picture";
  $("low-value").textContent = show(valueAt(state.low, measured()));
  $("high-value").textContent = show(valueAt(state.high, measured()));
  $("iso-value").textContent = show(Number(state.iso.toPrecision(3)));
  const two = data.images.length > 1 && left() !== right();
  $("about").textContent = two ? `${left().about}  |  ${right().about}` : left().about;
  const dark = state.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  document.documentElement.dataset.theme = dark;
}

// The link holds what differs from the start, such as #layer=opacity&zoom=4.
const START = { ...state };
let keeping = null;
function link() {
  const parts = Object.entries(state).filter(([key, value]) => value !== START[key]);
  return parts.map(([k, v]) => `${k}=${encodeURIComponent(v)}`).join("&");
}
function keep() {
  clearTimeout(keeping); // at rest: browsers refuse many changes a second
  keeping = setTimeout(() => {
    if (location.hash.slice(1) !== link()) location.replace(`#${link()}`);
  }, 250);
}

function restore() {
  const given = new URLSearchParams(location.hash.slice(1)), asked = {};
  for (const [key, text] of given) {
    if (!(key in START) || text === "null") continue;
    const number = typeof START[key] === "number" || ["from", "to", "zoom"].includes(key);
    if (number && !Number.isFinite(Number(text))) continue;
    asked[key] = number ? Number(text) : text;
  }
  const known = {
    layer: LAYERS.map(([n]) => n), colormap: Object.keys(data.colormaps),
    background: [...$("background").options].map((o) => o.value), theme: ["light", "dark"],
  };
  for (const [key, choices] of Object.entries(known)) {
    if (key in asked && !choices.includes(asked[key])) delete asked[key];
  }
  if (!/^[0-9a-f]{6}$/.test(asked.colour || "")) delete asked.colour;
  for (const key of ["left", "right"]) if (!data.images[asked[key]]) delete asked[key];
  if ((asked.from === undefined) !== (asked.to === undefined)) { delete asked.from; delete asked.to; }
  Object.assign(state, asked);
}

function nearer(factor, at) {
  const z = zoom() / devicePixelRatio, next = Math.min(64, Math.max(z * factor, 0.02));
  const [px, py] = at || [state.x, state.y]; // the point that stays where it is
  update({ zoom: next, x: px + (state.x - px) * (z / next), y: py + (state.y - py) * (z / next) });
}
const fit = () => update({ zoom: null, x: width / 2, y: height / 2 });

function listenToCanvas() {
  let from = null;
  canvas.addEventListener("pointerdown", (event) => {
    from = [event.clientX, event.clientY, state.x, state.y];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (from && event.buttons) {
      const z = zoom() / devicePixelRatio;
      update({ x: from[2] - (event.clientX - from[0]) / z, y: from[3] - (event.clientY - from[1]) / z });
    }
    cursor = pixelAt(event);
    drawValues();
    placeCross();
  });
  canvas.addEventListener("pointerup", () => { from = null; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = canvas.getBoundingClientRect(), z = zoom() / devicePixelRatio;
    const x = (event.clientX - box.left - box.width / 2) / z + state.x;
    const y = (event.clientY - box.top - box.height / 2) / z + state.y;
    nearer(2 ** (-event.deltaY / 300), [x, y]);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step) return;
    event.preventDefault();
    const far = event.shiftKey ? 10 : 1, [x, y] = cursor || [width >> 1, height >> 1];
    const clamp = (v, most) => Math.max(0, Math.min(most - 1, v));
    cursor = [clamp(x + far * step[0], width), clamp(y + far * step[1], height)];
    drawValues();
    placeCross();
  });
  for (const name of ["focus", "blur"]) canvas.addEventListener(name, placeCross);
}

function listenToHistogram() {
  const element = $("histogram");
  let from = null;
  const share = (event) => {
    const box = element.getBoundingClientRect();
    return Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
  };
  element.addEventListener("pointerdown", (event) => {
    from = share(event);
    element.setPointerCapture(event.pointerId);
  });
  element.addEventListener("pointermove", (event) => {
    if (from === null) return;
    const [a, b] = [from, share(event)].sort((p, q) => p - q);
    if (b > a) update({ from: valueAt(a, measured()), to: valueAt(b, measured()) });
  });
  element.addEventListener("pointerup", () => { from = null; });
}

function listen() {
  const value = (id) => (["wipe", "low", "high", "iso", "left", "right"].includes(id)
    ? Number($(id).value) : $(id).value);
  for (const id of ["wipe", "low", "high", "iso", "left", "right", "background", "colormap"]) {
    $(id).addEventListener("input", () => update({ [id]: value(id) }));
  }
  $("colour").addEventListener("input", () => (
    update({ colour: $("colour").value.slice(1), background: "custom" })));
  for (const id of ["log", "line"]) {
    $(id).addEventListener("input", () => update({ [id]: Number($(id).checked) }));
  }
  for (const id of ["from", "to"]) {
    $(id).addEventListener("change", () => {
      const [from, to] = ["from", "to"].map((e) => ($(e).value === "" ? null : Number($(e).value)));
      const { low, high } = ends(measured());
      if (from !== null || to !== null) update({ from: from ?? low, to: to ?? high });
    });
  }
  const nothing = () => update({ from: null, to: null });
  $("clear").addEventListener("click", nothing);
  $("fit").addEventListener("click", fit);
  $("actual").addEventListener("click", () => update({ zoom: 1 / devicePixelRatio }));
  $("theme").addEventListener("click", () => (
    update({ theme: document.documentElement.dataset.theme === "dark" ? "light" : "dark" })));
  $("copy").addEventListener("click", async () => {
    const url = `${location.href.split("#")[0]}#${link()}`;
    try {
      await navigator.clipboard.writeText(url);
      $("copied").textContent = "Copied.";
    } catch {
      $("copied").textContent = url;
    }
  });
  const keys = {
    b: () => {
      const all = [...$("background").options].map((o) => o.value);
      update({ background: all[(all.indexOf(state.background) + 1) % all.length] });
    },
    l: () => update({ log: 1 - state.log }), i: () => update({ line: 1 - state.line }), x: nothing,
    0: fit, "+": () => nearer(1.25), "=": () => nearer(1.25), "-": () => nearer(0.8),
  };
  addEventListener("keydown", (event) => {
    const typing = event.target.matches("select, input:not([type=checkbox], [type=radio], [type=range])");
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const layer = LAYERS[Number(event.key) - 1];
    if (layer && $(`layer-${layer[0]}`)) update({ layer: layer[0] });
    else if (keys[event.key]) keys[event.key]();
  });
  addEventListener("hashchange", () => {
    if (location.hash.slice(1) === link()) return;
    Object.assign(state, START);
    restore();
    refresh();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", refresh);
  listenToCanvas();
  listenToHistogram();
}

function build() {
  for (const [name, title] of LAYERS) {
    const there = name === "picture" ? data.images.some((i) => i.planes.red)
      : name !== "depth" || data.images.some((i) => i.planes.depth);
    if (!there) continue;
    const label = document.createElement("label");
    label.innerHTML = `<input type="radio" name="layer" id="layer-${name}"> `;
    label.append(title);
    label.firstChild.addEventListener("input", () => update({ layer: name }));
    $("layers").append(label);
  }
  for (const name of Object.keys(data.colormaps)) $("colormap").append(new Option(name, name));
  data.images.forEach(({ name }, i) => {
    for (const id of ["left", "right"]) $(id).append(new Option(name, i));
  });
  $("pair").hidden = $("wiping").hidden = data.images.length < 2;
}

async function begin() {
  build();
  for (const image of data.images) await load(image);
  if (!data.images.some((image) => image.planes.red)) START.layer = state.layer = "opacity";
  if (data.images.length < 2) START.right = state.right = 0;
  // The slider of the line reaches as far as there is opacity: of a thin medium not far.
  const most = Math.min(0.999, ends("opacity").high);
  Object.assign($("iso"), { min: most / 1000, max: most, step: most / 1000 });
  if (START.iso > most) START.iso = state.iso = Number((most / 2).toPrecision(3));
  restore();
  listen();
  new ResizeObserver(() => {
    sized(canvas);
    refresh();
  }).observe($("stage"));
  sized(canvas);
  refresh();
  $("wait").hidden = true;
  document.body.dataset.ready = "";
}

begin().catch((error) => { $("wait").textContent = `This page cannot be shown: ${error.message}`; });
