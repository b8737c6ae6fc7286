const $ = id => document.getElementById(id);
const shown = document.body.dataset;

function complain(text) {
  shown.error = text;
  $("error").textContent = text;
  $("error").hidden = false;
}
addEventListener("error", event => complain(event.message));
addEventListener("unhandledrejection", event => complain(String(event.reason)));

/** The block: length of a JSON text (4 bytes), the text, columns of numbers in byte planes. */
async function unpack() {
  if (typeof DecompressionStream === "undefined")
    throw new Error("This browser is too old for the replay: it has no DecompressionStream.");
  const packed = Uint8Array.from(atob($("data").textContent), c => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const start = 4 + new DataView(bytes.buffer).getUint32(0, true);
  const meta = JSON.parse(new TextDecoder().decode(bytes.subarray(4, start)));
  const columns = {};
  for (const [name, [offset, count, row, scale]] of Object.entries(meta.columns)) {
    const values = new Float64Array(count);
    let at = start + offset, whole = 0;
    for (let i = 0; i < count; i++, at++) {
      if (i % row === 0) whole = 0;
      const z = bytes[at] | bytes[at + count] << 8 | bytes[at + 2 * count] << 16 | bytes[at + 3 * count] << 24;
      whole += (z >>> 1) ^ -(z & 1);
      values[i] = whole / scale;
    }
    columns[name] = values;
  }
  const blocks = {};
  for (const [name, [offset, size]] of Object.entries(meta.blocks)) blocks[name] = bytes.subarray(start + offset, start + offset + size);
  return [meta, columns, blocks];
}

const [meta, C, B] = await unpack();
const T = meta.steps, N = meta.slots, times = C.time, first = times[0], last = times[T - 1];
const net = meta.network;

// --- vehicles in slots: runs of steps with one vehicle ------------------------------------------

const stays = Array.from({length: N}, () => []);
for (let slot = 0; slot < N; slot++)
  for (let k = 0, i = slot * T; k < T; k++, i++) {
    if (!C.vehicle[i]) continue;
    if (k && C.vehicle[i - 1] === C.vehicle[i]) stays[slot].at(-1).last = k;
    else stays[slot].push({slot, id: C.vehicle[i], first: k, last: k});
  }
// The ego is the first vehicle in its slot: another one may get the slot after it has left.
const egoStay = meta.ego === null ? null : stays[meta.ego][0] || null;
const egoThere = k => egoStay !== null && egoStay.first <= k && k <= egoStay.last;
const stayAt = (slot, k) => stays[slot].find(stay => stay.first <= k && k <= stay.last);

function pose(slot, k, u) {
  const i = slot * T + k;
  let x = C.x[i], y = C.y[i], heading = C.heading[i];
  if (u > 0 && C.vehicle[i + 1] === C.vehicle[i]) {
    x += u * (C.x[i + 1] - x);
    y += u * (C.y[i + 1] - y);
    const turn = C.heading[i + 1] - heading;
    heading += u * Math.atan2(Math.sin(turn), Math.cos(turn));
  }
  return {x, y, heading};
}

// --- state --------------------------------------------------------------------------------------

let t = first, k = 0, u = 0, playing = false, speed = 1, sel = null, follow = false, focus = null, hover = null;
const view = {x: 0, y: 0, scale: 1};
let width = 1, height = 1, ratio = 1, dirty = true, mapDirty = true;
const layers = {
  marks: ["Lane marks", true], connectors: ["Paths across junctions", true], walks: ["Crosswalks", true],
  lines: ["Stop lines", true], lights: ["Traffic lights", true], trails: ["Trails", false],
  path: ["Path of the selected", true], numbers: ["Slot numbers", true],
};
if (meta.plan) layers.plan = ["Planned trajectories", true];
if (meta.sense) layers.objects = ["Object list", true];
if (meta.interest || C.inside) layers.interest = ["Area of interest", true];
const on = name => layers[name] !== undefined && layers[name][1];
let colour = "speed";

function setTime(time, pause = false) {
  t = Math.min(Math.max(time, first), last);
  let low = 0, high = T - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t + 1e-6) low = middle; else high = middle - 1;
  }
  k = low;
  u = k + 1 < T ? Math.max(0, (t - times[k]) / (times[k + 1] - times[k])) : 0;
  if (pause) setPlaying(false);
  dirty = true;
}
function setPlaying(value) {
  if (value && t >= last) setTime(first);
  playing = value;
  $("playicon").setAttribute("d", playing ? "M3.500 2.500h3v11h-3zM9.500 2.500h3v11h-3z" : "M4 2.500l9 5.500-9 5.500z");
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  $("play").title = (playing ? "Pause" : "Play") + " (space)";
  dirty = true;
}
function setSpeed(value) {
  const choices = [0.25, 0.5, 1, 2, 4, 8];
  speed = choices.reduce((a, b) => Math.abs(Math.log(b / value)) < Math.abs(Math.log(a / value)) ? b : a);
  $("speed").value = String(speed);
}
function select(stay) {
  sel = stay || null;
  if (!sel) setFollow(false);
  dirty = true;
}
function selectSlot(slot) {
  let stay = stayAt(slot, k);
  if (!stay)  // empty now: the vehicle nearest in time
    for (const other of stays[slot]) {
      const away = o => Math.max(o.first - k, k - o.last);
      if (!stay || away(other) < away(stay)) stay = other;
    }
  select(stay);
}
function setFollow(value) {
  follow = Boolean(value && sel);
  if (follow && view.scale < 2) view.scale = closeUp();
  mapDirty = dirty = true;
}
const closeUp = () => Math.min(12, Math.max(3, Math.min(width, height) / 110));
function fit() {
  const [x0, y0, x1, y1] = net.bounds;
  follow = false;
  view.scale = Math.min(width / (x1 - x0), height / (y1 - y0));
  view.x = (x0 + x1) / 2;
  view.y = (y0 + y1) / 2;
  mapDirty = dirty = true;
}
function zoom(factor, px = width / 2, py = height / 2) {
  if (follow) { px = width / 2; py = height / 2; }
  const x = view.x + (px - width / 2) / view.scale, y = view.y - (py - height / 2) / view.scale;
  const [x0, y0, x1, y1] = net.bounds;
  const least = 0.5 * Math.min(width / (x1 - x0), height / (y1 - y0));
  view.scale = Math.min(Math.max(view.scale * factor, least), 120);
  view.x = x - (px - width / 2) / view.scale;
  view.y = y + (py - height / 2) / view.scale;
  mapDirty = dirty = true;
}
function step(n) {
  const at = Math.min(Math.max(k + n + (n < 0 && u > 1e-6 ? 1 : 0), 0), T - 1);
  setTime(times[at], true);
}
function goTo(moment) {
  focus = moment;
  setTime(moment.time, true);
  if (egoStay) select(egoStay);
  else if (moment.other !== null) selectSlot(moment.other);
  if (sel) { view.scale = Math.max(view.scale, closeUp()); setFollow(true); }
  dirty = true;
}
function nextMoment(direction) {
  const list = meta.moments;
  const found = direction > 0 ? list.find(m => m.time > t + 1e-3) : list.findLast(m => m.time < t - 1e-3);
  if (found) goTo(found);
}

// --- colours ------------------------------------------------------------------------------------

const prefersDark = matchMedia("(prefers-color-scheme: dark)");
let palette;
const channels = hex => [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16));
const mix = (a, b, share) => {
  const [p, q] = [channels(a), channels(b)];
  return `rgb(${p.map((x, i) => Math.round(x + share * (q[i] - x))).join(" ")})`;
};
function setPalette() {
  const dark = prefersDark.matches;
  const css = getComputedStyle(document.documentElement), get = name => css.getPropertyValue(name).trim();
  palette = {
    dark, ground: get("--ground"), panel: get("--panel"), ink: get("--ink"), faint: get("--faint"), rule: get("--rule"), accent: get("--accent"), boxes: get("--boxes"),
    // at night, what is lighter than the road by day is darker than it
    area: net.colors.map(color => {
      const [r, g, b] = channels(color), light = (0.3 * r + 0.6 * g + 0.1 * b) / 255;
      return dark ? mix(color, "#12161b", Math.min(0.95, 0.72 + Math.max(0, light - 0.74))) : color;
    }),
    mark: dark ? "#a9b2bd" : "#ffffff", edge: dark ? "#77818d" : "#5d6773", kerb: dark ? "#39414b" : "#b9bfc7",
    centre: dark ? "#c79a1c" : "#f0b400", connector: dark ? "#ffffff22" : "#2f374230", walk: dark ? "#a9b2bd" : "#ffffff",
    outline: dark ? "#0b0e12" : "#2f3742", plain: dark ? "#aab4c0" : "#6c7784",
    speed: dark ? ["#7d63d9", "#5a8ff0", "#2cbfae", "#8edb5a", "#fde725"] : ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"],
    accelerate: ["#c8102e", "#ef8a62", dark ? "#aab4c0" : "#8b95a1", "#67a9cf", "#2166ac"],
    ttc: ["#d7191c", "#f46d1b", "#ffb000", "#a9b85a", dark ? "#aab4c0" : "#8b95a1"],
  };
  mapDirty = dirty = true;
  setColour(colour);
}
const topSpeed = 5 * Math.ceil(Math.max(10, ...net.limits) / 5);
const ramps = {
  speed: ["speed, m/s", () => palette.speed, 0, topSpeed, i => C.v[i]],
  acceleration: ["acceleration, m/s²", () => palette.accelerate, -4, 4, i => C.a[i]],
  ttc: ["time to collision, s", () => palette.ttc, 0, 8, i => {
    const both = [C.ttc[i], C.soonest[i]].filter(x => x >= 0);
    return both.length ? Math.min(...both) : 99;
  }],
};
function paint(i) {
  const [, colors, low, high, value] = ramps[colour], stops = colors();
  const x = Math.min(Math.max((value(i) - low) / (high - low), 0), 1) * (stops.length - 1);
  const j = Math.min(Math.floor(x), stops.length - 2);
  return mix(stops[j], stops[j + 1], x - j);
}
function setColour(name) {
  colour = name;
  const [label, colors, low, high] = ramps[name];
  $("rampname").textContent = label;
  $("ramp").style.background = `linear-gradient(to right, ${colors().join(", ")})`;
  $("low").textContent = String(low).replace("-", "−");
  $("high").textContent = name === "ttc" ? `${high} or none` : String(high);
  dirty = true;
}

