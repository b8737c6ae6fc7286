// --- numbers and plots of the selected vehicle --------------------------------------------------

const minus = text => text.replace(/-(?=[0-9])/g, "−");
const facts = {};
function fact(name, label, text, value) {
  let dd = facts[name];
  if (!dd) {
    const dt = document.createElement("dt");
    dd = facts[name] = document.createElement("dd");
    dt.textContent = label;
    dd.dataset.field = name;
    $("facts").append(dt, dd);
  }
  dd.textContent = text;
  dd.dataset.value = value === null || value === undefined ? "" : String(value);
}
function inspect() {
  $("unselected").hidden = Boolean(sel);
  $("selected").hidden = $("plots").hidden = !sel;
  $("follow").disabled = !sel;
  if (!sel) return;
  const there = sel.first <= k && k <= sel.last, j = Math.min(Math.max(k, sel.first), sel.last), i = sel.slot * T + j;
  $("who").textContent = `Slot ${sel.slot}`;
  $("isego").hidden = sel !== egoStay;
  $("bits").replaceChildren(...Object.entries(meta.status).filter(([bit]) => C.status[i] & bit).map(([, text]) => {
    const chip = document.createElement("span");
    chip.className = "chip";
    chip.textContent = text;
    return chip;
  }));
  const lead = C.lead[i], of = C.soonest_of[i], lane = C.lane[i], limit = net.limits[lane];
  const number = (x, digits) => minus(x.toFixed(digits));
  const span = `${times[sel.first].toFixed(1)} to ${times[sel.last].toFixed(1)} s`;
  const gone = sel === egoStay && meta.arrived !== null && k > sel.last ? "arrived" : "not on the road now";
  $("span").textContent = there ? span : `${span}, ${gone}`;
  shown.there = there;
  fact("vehicle", "vehicle", sel.id === 1 ? "there at the start" : `row ${sel.id - 2} of the schedule`, sel.id - 2);
  const size = `${C.length[i].toFixed(2)} × ${C.width[i].toFixed(2)} m`, kind = C.class && C.class[i] >= 0 ? C.class[i] : null;
  fact("class", "body", kind === null ? size : `${meta.classes[kind]}, ${size}`, kind);
  if (rows) fact("driver", "driven by", drivenAt(sel.slot, j) ? "the policy" : "the traffic model", null);
  const goes = C.to_go && sel === egoStay, to_go = goes && C.to_go[j] >= 0 ? C.to_go[j] : null;
  fact("lane", "lane", lane in net.lanes ? net.lanes[lane] : "none", lane);
  fact("s", "s, d", `${number(C.s[i], 2)} m, ${number(C.d[i], 2)} m`, C.s[i]);
  facts.s.dataset.d = C.d[i];
  fact("x", "x, y", `${number(C.x[i] + net.origin[0], 2)} m, ${number(C.y[i] + net.origin[1], 2)} m`, C.x[i] + net.origin[0]);
  facts.x.dataset.y = C.y[i] + net.origin[1];
  fact("v", "speed", `${number(C.v[i], 2)} m/s, ${number(3.6 * C.v[i], 0)} km/h`, C.v[i]);
  fact("limit", "limit", limit === undefined ? "none" : `${limit.toFixed(2)} m/s, ${(3.6 * limit).toFixed(0)} km/h`, limit);
  fact("a", "acceleration", `${number(C.a[i], 2)} m/s²`, C.a[i]);
  if (C.to_go) {
    fact("to_go", "to the goal", to_go === null ? "–" : `${number(to_go, 1)} m`, to_go);
    facts.to_go.hidden = facts.to_go.previousSibling.hidden = $("goal").hidden = !goes;
    facts.to_go.title = "along the route, with 30 m for each change of lanes";
  }
  const headway = lead >= 0 && C.v[i] > 0.5 ? `, ${(C.gap[i] / C.v[i]).toFixed(1)} s` : "";
  fact("gap", "gap to leader", lead < 0 ? "none ahead" : `${number(C.gap[i], 2)} m${headway}, slot ${lead}`, lead < 0 ? null : C.gap[i]);
  facts.gap.dataset.lead = lead;
  fact("ttc", "TTC, leader", C.ttc[i] < 0 ? "–" : `${C.ttc[i].toFixed(2)} s`, C.ttc[i] < 0 ? null : C.ttc[i]);
  fact("soonest", "TTC, boxes", C.soonest[i] < 0 ? "–" : `${C.soonest[i].toFixed(2)} s, slot ${of}`, C.soonest[i] < 0 ? null : C.soonest[i]);
  facts.soonest.dataset.of = of;
  facts.ttc.title = facts.gap.title = "1-D: the next vehicle ahead on its lanes, which keeps its speed";
  facts.soonest.title = "2-D: the first box that it would touch if all kept speed and heading";
  $("at_v").textContent = there ? number(C.v[i], 1) : "";
  $("at_a").textContent = there ? number(C.a[i], 1) : "";
  $("at_ttc").textContent = there ? [C.ttc[i], C.soonest[i]].map(x => x < 0 ? "–" : x.toFixed(1)).join(", ") : "";
  plot($("plot_v"), [["v", palette.accent, []], ["limit", palette.faint, [3, 3]]], "v");
  plot($("plot_a"), [["a", palette.accent, []]], "a");
  if (goes) {
    $("at_to_go").textContent = there && to_go !== null ? number(to_go, 1) : "";
    plot($("plot_to_go"), [["to_go", palette.accent, []]], "to_go");
  }
  plot($("plot_ttc"), [["soonest", palette.boxes, []], ["ttc", palette.accent, []]], "ttc", true);
}
const margin = {left: 30, right: 6, top: 4, bottom: 3};
// the same as that of the slider
const plotRange = () => last - first < 2 ? [first, first + 2] : [first, last];
function series(name, j) {
  const i = sel.slot * T + j;
  if (name === "limit") return net.limits[C.lane[i]] ?? NaN;
  const value = name === "to_go" ? C.to_go[j] : C[name][i];
  return (name === "ttc" || name === "soonest" || name === "to_go") && value < 0 ? NaN : value;
}
const extents = new WeakMap();  // of the selected stay, so that axes stand still
function extent(names, kind) {
  const known = extents.get(sel) || extents.set(sel, {}).get(sel);
  if (known[kind]) return known[kind];
  if (kind === "ttc") return known[kind] = [0, 10];
  let low = kind === "a" ? -2 : 0, high = kind === "a" ? 2 : 5;
  for (let j = sel.first; j <= sel.last; j++)
    for (const name of names) {
      const y = series(name, j);
      if (y < low) low = y;
      if (y > high) high = y;
    }
  return known[kind] = [kind === "a" ? Math.floor(low) : low, kind === "a" ? Math.ceil(high) : 1.06 * high];
}
function plot(canvas, lines, kind, axis = false) {
  const w = canvas.clientWidth, h = canvas.clientHeight;
  if (!w) return;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const ctx = canvas.getContext("2d"), [a, b] = plotRange(), [low, high] = extent(lines.map(x => x[0]), kind);
  const bottom = margin.bottom + (axis ? 16 : 0), floor = h - bottom;
  const px = time => margin.left + (time - a) / (b - a) * (w - margin.left - margin.right);
  const py = y => floor - (y - low) / (high - low) * (floor - margin.top);
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, w, h);
  ctx.font = "10px system-ui, sans-serif";
  ctx.lineWidth = 1;
  ctx.textBaseline = "middle";
  ctx.textAlign = "right";
  const steps = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000], gap = steps.find(x => (high - low) / x <= 4) || 10000;
  for (let y = Math.ceil(low / gap) * gap; y <= high + 1e-9; y += gap) {
    ctx.strokeStyle = palette.rule; ctx.globalAlpha = Math.abs(y) < 1e-9 ? 1 : 0.6;
    ctx.beginPath(); ctx.moveTo(margin.left, py(y)); ctx.lineTo(w - margin.right, py(y)); ctx.stroke();
    ctx.globalAlpha = 1; ctx.fillStyle = palette.faint;
    ctx.fillText(minus(String(y)), margin.left - 5, Math.min(Math.max(py(y), 6), floor - 3));
  }
  if (axis) {
    ctx.textAlign = "center"; ctx.textBaseline = "alphabetic";
    const tick = [0.5, 1, 2, 5, 10, 20, 50, 100, 200].find(x => (b - a) / x <= 7) || 500;
    for (let x = Math.ceil(a / tick - 1e-9) * tick; x <= b + 1e-9; x += tick) {
      const text = `${+x.toFixed(1)}`, at = px(x);
      ctx.fillText(text, Math.min(at, w - margin.right - 6), h - 4);
      ctx.strokeStyle = palette.rule;
      ctx.beginPath(); ctx.moveTo(at, floor); ctx.lineTo(at, floor + 3); ctx.stroke();
    }
    ctx.fillStyle = "#d7191c22";
    ctx.fillRect(margin.left, py(1.5), w - margin.left - margin.right, py(0) - py(1.5));
  }
  ctx.save();
  ctx.beginPath(); ctx.rect(margin.left, margin.top - 2, w - margin.left - margin.right, floor - margin.top + 4); ctx.clip();
  if (sel === egoStay)
    for (const moment of meta.moments) {
      ctx.strokeStyle = moment.color; ctx.globalAlpha = 0.65;
      ctx.beginPath(); ctx.moveTo(px(moment.time), margin.top); ctx.lineTo(px(moment.time), floor); ctx.stroke();
      ctx.globalAlpha = 1;
    }
  for (const [name, color, dash] of lines) {
    ctx.strokeStyle = color; ctx.lineWidth = name === "limit" ? 1 : 1.5; ctx.setLineDash(dash); ctx.lineJoin = "round";
    ctx.beginPath();
    let down = false;
    for (let j = sel.first; j <= sel.last; j++) {
      const y = series(name, j);
      if (!(y <= 1.5 * high)) { down = false; continue; }
      if (down) ctx.lineTo(px(times[j]), py(y)); else ctx.moveTo(px(times[j]), py(y));
      down = true;
    }
    ctx.stroke();
    ctx.setLineDash([]);
  }
  ctx.restore();
  if (t >= a - 1e-6 && t <= b + 1e-6) {
    ctx.strokeStyle = palette.ink; ctx.lineWidth = 1.2;
    ctx.beginPath(); ctx.moveTo(px(t), 0); ctx.lineTo(px(t), floor); ctx.stroke();
  }
}
for (const name of ["v", "a", "to_go", "ttc"]) {
  const canvas = $("plot_" + name);
  const move = event => {
    const box = canvas.getBoundingClientRect(), [a, b] = plotRange();
    const share = (event.clientX - box.left - margin.left) / (box.width - margin.left - margin.right);
    setTime(Math.min(Math.max(a + share * (b - a), a), b), true);
  };
  canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); move(event); });
  canvas.addEventListener("pointermove", event => { if (event.buttons) move(event); });
}

// --- frame --------------------------------------------------------------------------------------

let before = null;
function frame(now) {
  if (playing && before !== null) {
    const on = t + speed * Math.min(0.25, (now - before) / 1000);
    setTime(on);
    if (on >= last) setPlaying(false);
  }
  before = now;
  show();
  requestAnimationFrame(frame);
}
function show() {
  if (!dirty) return;
  dirty = false;
  draw();
  drawSense();
  tellAnswer();
  inspect();
  const share = last > first ? (t - first) / (last - first) : 1;
  $("done").style.width = $("knob").style.left = `${100 * share}%`;
  $("now").textContent = `${t.toFixed(1)} s`;
  const count = poses.filter(Boolean).length;
  $("count").textContent = String(count);
  $("countword").textContent = count === 1 ? "vehicle" : "vehicles";
  $("time").setAttribute("aria-valuenow", t.toFixed(2));
  $("time").setAttribute("aria-valuetext", `${t.toFixed(1)} seconds`);
  $("follow").setAttribute("aria-pressed", String(follow));
  $("before").disabled = !meta.moments.some(m => m.time < t - 1e-3);
  $("after").disabled = !meta.moments.some(m => m.time > t + 1e-3);
  momentButtons.forEach(([moment, button]) => button.setAttribute("aria-current", String(moment === focus && Math.abs(t - moment.time) < 0.5)));
  scaleBar();
  if (!playing && before !== null) tellAddress();
  shown.time = t.toFixed(4); shown.step = k; shown.playing = playing; shown.speed = speed; shown.count = count;
  shown.selected = sel ? sel.slot : ""; shown.follow = follow; shown.colour = colour;
  shown.scale = view.scale; shown.x = view.x + net.origin[0]; shown.y = view.y + net.origin[1];
  shown.vehicles = poses.map((p, slot) => [slot, X(p.x).toFixed(1), Y(p.y).toFixed(1)].join(",")).filter(Boolean).join(" ");
  shown.ready = 1;
}
function scaleBar() {
  const room = 110 / view.scale, unit = 10 ** Math.floor(Math.log10(room));
  const metres = [5, 2, 1].map(x => x * unit).find(x => x <= room) || unit;
  $("bar").style.width = `${metres * view.scale}px`;
  $("scale").textContent = metres < 1000 ? `${+metres.toPrecision(1)} m` : `${metres / 1000} km`;
}

// --- hands --------------------------------------------------------------------------------------

function under(px, py) {
  let found = null, nearest = 14;
  poses.forEach((p, slot) => {
    const i = slot * T + k, dx = px - X(p.x), dy = Y(p.y) - py, c = Math.cos(p.heading), s = Math.sin(p.heading);
    const e = boost() * view.scale;
    const off = Math.hypot(Math.max(0, Math.abs(dx * c + dy * s) - C.length[i] * e / 2), Math.max(0, Math.abs(dy * c - dx * s) - C.width[i] * e / 2));
    const away = off + 0.01 * Math.hypot(dx, dy);
    if (off < 12 && away < nearest) { nearest = away; found = slot; }
  });
  return found;
}
const pointers = new Map();
let moved = 0;
canvas.addEventListener("pointerdown", event => {
  canvas.setPointerCapture(event.pointerId);
  if (!pointers.size) moved = 0;
  pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
});
canvas.addEventListener("pointermove", event => {
  const was = pointers.get(event.pointerId), is = [event.offsetX, event.offsetY];
  if (!was) {
    hover = under(...is);
    canvas.classList.toggle("over", hover !== null);
    $("tip").hidden = hover === null;
    if (hover !== null) {
      const i = hover * T + k;
      $("tip").textContent = `${hover === meta.ego && egoThere(k) ? "ego, " : ""}slot ${hover}${C.class ? `, ${meta.classes[C.class[i]]}` : ""}: ${C.v[i].toFixed(1)} m/s, ${minus(C.a[i].toFixed(1))} m/s²`;
      $("tip").style.left = `${is[0]}px`; $("tip").style.top = `${is[1]}px`;
    }
    return;
  }
  const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
  moved += Math.hypot(is[0] - was[0], is[1] - was[1]);
  pointers.set(event.pointerId, is);
  if (moved < 4) return;
  $("tip").hidden = true;
  canvas.classList.add("drag");
  if (others.length) {
    const [o] = others, size = at => Math.hypot(at[0] - o[0], at[1] - o[1]);
    moved = 99;
    pan((is[0] - was[0]) / 2, (is[1] - was[1]) / 2);
    zoom(size(is) / Math.max(1, size(was)), (is[0] + o[0]) / 2, (is[1] + o[1]) / 2);
  } else pan(is[0] - was[0], is[1] - was[1]);
});
function pan(dx, dy) {
  follow = false;
  view.x -= dx / view.scale; view.y += dy / view.scale;
  mapDirty = dirty = true;
}
function up(event) {
  const known = pointers.delete(event.pointerId);
  if (!pointers.size) canvas.classList.remove("drag");
  if (!known || moved >= 4 || event.type === "pointercancel") return;
  const slot = under(event.offsetX, event.offsetY);
  if (slot === null) select(null);
  else select(stayAt(slot, k));
}
canvas.addEventListener("pointerup", up);
canvas.addEventListener("pointercancel", up);
canvas.addEventListener("pointerleave", () => { $("tip").hidden = true; });
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  const unit = event.deltaMode === 1 ? 24 : event.deltaMode === 2 ? 400 : 1;
  zoom(Math.exp(-Math.min(Math.max(event.deltaY * unit, -300), 300) * (event.ctrlKey ? 0.01 : 0.0018)), event.offsetX, event.offsetY);
}, {passive: false});
canvas.addEventListener("dblclick", event => zoom(2, event.offsetX, event.offsetY));

{
  const track = $("time");
  const move = event => {
    const box = track.getBoundingClientRect();
    setTime(first + (event.clientX - box.left) / box.width * (last - first), true);
  };
  track.addEventListener("pointerdown", event => {
    if (event.target.classList.contains("mark")) return;
    track.setPointerCapture(event.pointerId);
    move(event);
  });
  track.addEventListener("pointermove", event => { if (track.hasPointerCapture(event.pointerId)) move(event); });
  track.setAttribute("aria-valuemin", first.toFixed(2));
  track.setAttribute("aria-valuemax", last.toFixed(2));
}
$("play").onclick = () => setPlaying(!playing);
$("back").onclick = () => step(-1);
$("forth").onclick = () => step(1);
$("before").onclick = () => nextMoment(-1);
$("after").onclick = () => nextMoment(1);
$("speed").onchange = event => setSpeed(Number(event.target.value));
$("closer").onclick = () => zoom(1.5);
$("farther").onclick = () => zoom(1 / 1.5);
$("fit").onclick = fit;
$("sensing").onclick = () => setSensing(!lit);
$("follow").onclick = () => setFollow(!follow);
$("drop").onclick = () => select(null);
// Keys belong to the map again after a click or a choice by mouse: otherwise space would repeat the button.
let byPointer = false;
addEventListener("pointerdown", () => { byPointer = true; }, true);
addEventListener("keydown", () => { byPointer = false; }, true);
for (const kind of ["click", "change"])
  addEventListener(kind, event => {
    if (byPointer && event.target.closest("button, select, summary, input") && !(kind === "click" && event.target.closest("select")))
      canvas.focus({preventScroll: true});
  });
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
  if (event.key === " " && ["BUTTON", "SUMMARY"].includes(event.target.tagName)) return;
  const second = Math.max(1, Math.round(1 / (T > 1 ? (last - first) / (T - 1) : 1)));
  const keys = {
    " ": () => setPlaying(!playing), ArrowLeft: () => step(event.shiftKey ? -second : -1), ArrowRight: () => step(event.shiftKey ? second : 1),
    Home: () => setTime(first, true), End: () => setTime(last, true), p: () => nextMoment(-1), n: () => nextMoment(1),
    "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), "0": fit, f: () => setFollow(!follow), Escape: () => select(null),
    "<": () => setSpeed(speed / 2), ">": () => setSpeed(speed * 2), ",": () => setSpeed(speed / 2), ".": () => setSpeed(speed * 2),
    c: () => { if (sense) setSensing(!lit); },
    e: () => { if (egoStay) { select(egoStay); setFollow(true); } },
  };
  if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
});

// --- what stands beside the map -----------------------------------------------------------------

$("title").textContent = meta.title;
$("map").textContent = meta.map;
$("end").textContent = `/ ${last.toFixed(1)} s`;
for (const [name, entry] of Object.entries(layers)) {
  const row = document.createElement("label"), box = document.createElement("input");
  box.type = "checkbox"; box.checked = entry[1]; box.dataset.layer = name;
  box.onchange = () => { entry[1] = box.checked; mapDirty = dirty = true; };
  row.append(box, entry[0]);
  $("layers").append(row);
}
{
  const row = document.createElement("label"), choice = document.createElement("select");
  choice.id = "colour";
  for (const name of Object.keys(ramps)) choice.append(new Option(name === "ttc" ? "time to collision" : name, name));
  choice.onchange = () => setColour(choice.value);
  row.append("Colour:", choice);
  $("layers").append(row);
}
if (C.driven && C.driven.some(slot => slot >= 0 && slot !== meta.ego)) {
  $("outlined").hidden = false;
  $("outlined").querySelector("i").style.border = `2.5px solid ${meta.colors.driven}`;
}
if (egoStay) {
  $("egosign").hidden = false;
  $("egosign").querySelector("i").style.background = meta.colors.ego;
}
$("sensekey").hidden = $("sensetext").hidden = $("believed").hidden = !sense;
if (sense) $("believed").querySelector("i").style.border = `1.5px solid ${sense.colors.found_by_day}`;
if (meta.plan) {
  $("planned").hidden = false;
  $("planned").querySelector("i").style.borderTop = `2.5px solid ${meta.colors.ego}`;
}
const momentButtons = meta.moments.map(moment => {
  const item = document.createElement("li"), button = document.createElement("button");
  const dot = document.createElement("i"), at = document.createElement("span"), what = document.createElement("span"), who = document.createElement("small");
  dot.style.background = moment.color;
  at.className = "number";
  at.textContent = `${moment.time.toFixed(1)} s`;
  what.textContent = [moment.label, moment.value && minus(moment.value)].filter(Boolean).join(", ") + (moment.rank === 1 ? " (worst)" : "");
  who.textContent = [
    moment.other === null ? null : `slot ${moment.other}`, moment.who && `responsible: ${moment.who}`, moment.module,
  ].filter(Boolean).join(", ");
  button.append(dot, at, what, who);
  button.onclick = () => goTo(moment);
  item.append(button);
  $("moments").querySelector("ol").append(item);
  const mark = document.createElement("button");
  mark.className = "mark";
  mark.tabIndex = -1;
  mark.style.background = moment.color;
  mark.style.left = `${last > first ? 100 * (moment.time - first) / (last - first) : 100}%`;
  mark.title = [`${moment.time.toFixed(1)} s: ${what.textContent}`, who.textContent].filter(Boolean).join("\n");
  mark.setAttribute("aria-label", mark.title);
  mark.onclick = () => goTo(moment);
  $("time").append(mark);
  return [moment, button];
});
$("moments").hidden = !meta.moments.length;
{
  const gap = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600].find(x => (last - first) / x <= 8) || 1200;
  for (let x = Math.ceil(first / gap - 0.11) * gap; x <= last + 1e-6; x += gap) {
    const tick = document.createElement("span"), share = last > first ? (x - first) / (last - first) : 0;
    tick.textContent = `${x} s`;
    tick.className = share > 0.97 ? "number last" : "number";
    tick.style.left = `${Math.max(0, 100 * share)}%`;
    $("time").append(tick);
  }
}

function resize() {
  const box = $("stage").getBoundingClientRect();
  ratio = Math.min(devicePixelRatio || 1, 3);
  width = Math.max(1, box.width); height = Math.max(1, box.height);
  canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  mapDirty = dirty = true;
}
function readFragment() {
  const wanted = new URLSearchParams(location.hash.slice(1));
  const number = name => wanted.has(name) && Number.isFinite(Number(wanted.get(name))) ? Number(wanted.get(name)) : null;
  if (number("t") !== null) setTime(number("t"), true);
  if (number("speed") > 0) setSpeed(number("speed"));
  if (wanted.get("colour") in ramps) { $("colour").value = wanted.get("colour"); setColour(wanted.get("colour")); }
  if (number("select") !== null && stays[number("select")]) { selectSlot(number("select")); if (!wanted.has("follow")) setFollow(false); }
  if (wanted.has("follow")) setFollow(wanted.get("follow") !== "0");
  const [x, y, scale] = (wanted.get("view") || "").split(",").map(Number);
  if (wanted.get("view") === "fit") fit();
  else if (scale > 0) { follow = false; Object.assign(view, {x: x - net.origin[0], y: y - net.origin[1], scale}); mapDirty = dirty = true; }
  if (wanted.get("play") === "1") setPlaying(true);
}
addEventListener("hashchange", readFragment);
// The address leads to the moment shown, once the replay stands still.
let told = "", waits = 0;
function tellAddress() {
  const at = `#t=${t.toFixed(1)}` + (sel ? `&select=${sel.slot}&follow=${Number(follow)}` : "");
  if (at === told) return;
  told = at;
  clearTimeout(waits);
  waits = setTimeout(() => { try { history.replaceState(null, "", at); } catch { /* within the frame of a notebook */ } }, 300);
}
// A canvas is empty after a change of its size: it is drawn before that is shown.
new ResizeObserver(() => { resize(); show(); }).observe($("stage"));
new ResizeObserver(() => { dirty = true; }).observe($("sense"));
prefersDark.addEventListener("change", setPalette);
setPalette();
resize();
fit();
setTime(first);
if (egoStay) { select(egoStay); setFollow(true); }
readFragment();
requestAnimationFrame(frame);
