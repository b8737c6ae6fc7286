// --- the map, drawn once per view ---------------------------------------------------------------

const storeys = [], boxOf = [];
{
  let at = 0;
  const sides = [];
  const line = (from, to) => {
    const path = new Path2D();
    for (let i = from; i < to; i++) path.lineTo(C.border_x[i], C.border_y[i]);
    return path;
  };
  const storey = level => storeys[level] ||= {areas: [], marks: [], connectors: []};
  net.count.forEach((n, lane) => {
    const path = line(at, at + n), box = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = at + 2 * n - 1; i >= at + n; i--) path.lineTo(C.border_x[i], C.border_y[i]);
    path.closePath();
    for (let i = at; i < at + 2 * n; i++) {
      box[0] = Math.min(box[0], C.border_x[i]); box[1] = Math.min(box[1], C.border_y[i]);
      box[2] = Math.max(box[2], C.border_x[i]); box[3] = Math.max(box[3], C.border_y[i]);
    }
    storey(net.level[lane]).areas.push({path, box, area: net.area[lane]});
    sides.push({at, n, box});
    boxOf.push(box);
    at += 2 * n;
  });
  for (const [kind, lane, side, shift] of net.marks) {
    const {at, n, box} = sides[lane], path = new Path2D();
    for (let i = 0; i < n; i++) {
      const own = at + side * n + i, far = at + (1 - side) * n + i;
      let x = C.border_x[own], y = C.border_y[own];
      if (shift) {
        const dx = x - C.border_x[far], dy = y - C.border_y[far], wide = Math.hypot(dx, dy) || 1;
        x += shift * dx / wide; y += shift * dy / wide;
      }
      path.lineTo(x, y);
    }
    storey(net.level[lane]).marks.push({path, box, kind});
  }
  for (const [lane] of net.connectors) {
    const {at, n, box} = sides[lane], path = new Path2D();
    for (let i = at; i < at + n; i++) path.lineTo((C.border_x[i] + C.border_x[i + n]) / 2, (C.border_y[i] + C.border_y[i + n]) / 2);
    storey(net.level[lane]).connectors.push({path, box});
  }
}
// Connectors leave gaps of pavement between them: what they and their neighbours enclose is filled, unless
// it is large (the island of a roundabout). Cells below the lanes, so that lanes draw the edges.
{
  const most = 80, groups = new Map();  // m²
  for (const [lane, junction] of net.connectors) {
    const key = `${junction} ${net.level[lane]}`;
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(lane);
  }
  const board = document.createElement("canvas"), ctx = board.getContext("2d", {willReadFrequently: true});
  for (const lanes of groups.values()) {
    const storey = storeys[net.level[lanes[0]]], boxes = lanes.map(lane => boxOf[lane]);
    const box = [0, 1, 2, 3].map(i => (i < 2 ? Math.min : Math.max)(...boxes.map(b => b[i])) + (i < 2 ? -2 : 2));
    const fine = Math.min(4, 500 / Math.max(box[2] - box[0], box[3] - box[1]));  // cells per m
    const w = board.width = Math.ceil((box[2] - box[0]) * fine), h = board.height = Math.ceil((box[3] - box[1]) * fine);
    ctx.setTransform(fine, 0, 0, fine, -fine * box[0], -fine * box[1]);
    for (const item of storey.areas)
      if (item.box[0] < box[2] && item.box[2] > box[0] && item.box[1] < box[3] && item.box[3] > box[1]) ctx.fill(item.path);
    const pixels = ctx.getImageData(0, 0, w, h).data, seen = new Uint8Array(w * h), path = new Path2D();
    let found = false;
    for (let start = 0; start < w * h; start++) {
      if (seen[start] || pixels[4 * start + 3] > 127) continue;
      const cells = [start];
      let open = false;
      seen[start] = 1;
      for (let i = 0; i < cells.length; i++) {
        const cell = cells[i], x = cell % w, y = (cell - x) / w;
        if (x === 0 || y === 0 || x === w - 1 || y === h - 1) { open = true; continue; }
        for (const next of [cell - 1, cell + 1, cell - w, cell + w])
          if (!seen[next] && pixels[4 * next + 3] <= 127) { seen[next] = 1; cells.push(next); }
      }
      if (open || cells.length > most * fine * fine) continue;
      found = true;
      for (const cell of cells) path.rect(box[0] + (cell % w - 1) / fine, box[1] + (Math.floor(cell / w) - 1) / fine, 3 / fine, 3 / fine);
    }
    if (found) storey.areas.unshift({path, box, area: net.colors.length - 1});
  }
}
const walks = new Path2D();
{
  let at = 0;
  for (const n of net.stripes) {
    for (let i = at; i < at + n; i++) walks[i === at ? "moveTo" : "lineTo"](C.stripe_x[i], C.stripe_y[i]);
    walks.closePath();
    at += n;
  }
}
const base = document.createElement("canvas"), canvas = $("view"), pen = canvas.getContext("2d");

function world(ctx) {
  const s = view.scale * ratio;
  ctx.setTransform(s, 0, 0, -s, ratio * width / 2 - s * view.x, ratio * height / 2 + s * view.y);
}
const X = x => width / 2 + (x - view.x) * view.scale, Y = y => height / 2 - (y - view.y) * view.scale;

function drawMap() {
  if (base.width !== canvas.width || base.height !== canvas.height) {
    base.width = canvas.width; base.height = canvas.height;
  }
  const ctx = base.getContext("2d"), s = view.scale;
  ctx.setTransform(1, 0, 0, 1, 0, 0);
  ctx.fillStyle = palette.ground;
  ctx.fillRect(0, 0, base.width, base.height);
  world(ctx);
  const w = width / s / 2, h = height / s / 2;
  const visible = item => item.box[0] < view.x + w && item.box[2] > view.x - w && item.box[1] < view.y + h && item.box[3] > view.y - h;
  const thin = Math.min(Math.max(0.15 * s, 0.5), 2.4) / s;
  const styles = {
    kerb: [palette.kerb, 0.6 * thin, null], edge: [palette.edge, thin, null], solid: [palette.mark, thin, null],
    dashed: [palette.mark, thin, [Math.max(3, 5 / s), Math.max(4.500, 6 / s)]], centre: [palette.centre, 1.2 * thin, null],
  };
  ctx.lineJoin = "round";
  for (const storey of storeys) {
    if (!storey) continue;
    ctx.setLineDash([]);
    for (const item of storey.areas) {
      if (!visible(item)) continue;
      ctx.lineWidth = item.area === net.colors.length - 1 ? Math.max(0.25, 0.5 / s) : 0.5 / s;  // closes seams
      ctx.fillStyle = ctx.strokeStyle = palette.area[item.area];
      ctx.fill(item.path);
      ctx.stroke(item.path);
    }
    if (on("connectors") && s > 1.5) {
      ctx.strokeStyle = palette.connector;
      ctx.lineWidth = Math.min(Math.max(0.12 * s, 0.7), 1.5) / s;
      for (const item of storey.connectors) if (visible(item)) ctx.stroke(item.path);
    }
    if (on("marks"))
      for (const item of storey.marks) {
        // where lanes are thinner than the marks would be, marks hide the lanes
        if (!visible(item) || (s < 0.6 && (item.kind === "solid" || item.kind === "dashed"))) continue;
        const [color, wide, dash] = styles[item.kind];
        ctx.strokeStyle = color; ctx.lineWidth = wide; ctx.setLineDash(dash || []);
        ctx.stroke(item.path);
      }
  }
  ctx.setLineDash([]);
  if (on("walks") && s > 0.8) {
    ctx.fillStyle = palette.walk;
    ctx.globalAlpha = palette.dark ? 0.55 : 0.9;
    ctx.fill(walks);
    ctx.globalAlpha = 1;
  }
  if (on("lines") && s > 0.8) {
    ctx.strokeStyle = palette.mark;
    net.lines.forEach((kind, i) => {
      ctx.lineWidth = (kind === "stop" ? 0.45 : 0.4);
      ctx.setLineDash(kind === "stop" ? [] : [0.5, 0.35]);
      ctx.beginPath();
      ctx.moveTo(C.line_x[2 * i], C.line_y[2 * i]);
      ctx.lineTo(C.line_x[2 * i + 1], C.line_y[2 * i + 1]);
      ctx.stroke();
    });
    ctx.setLineDash([]);
  }
  mapDirty = false;
}

// --- the traffic --------------------------------------------------------------------------------

function lastAt(list, time) {
  let found = -1;
  for (let i = 0; i < list.length && list[i] <= time + 1e-6; i++) found = i;
  return found;
}
function interestArea() {
  const {time, count} = meta.interest, i = lastAt(time, t);
  if (i < 0) return false;
  const start = count.slice(0, i).reduce((a, b) => a + b, 0);
  pen.beginPath();
  for (let j = start; j < start + count[i]; j++) pen.lineTo(X(C.interest_x[j]), Y(C.interest_y[j]));
  pen.closePath();
  return true;
}
const rows = C.driven ? C.driven.length / T : 0;  // of egos and others that the policy may drive
function drivenAt(slot, k) {
  if (slot === meta.ego && !egoThere(k)) return false;
  for (let row = 0; row < rows; row++) if (C.driven[row * T + k] === slot) return true;
  return false;
}
function drawPlan(row) {
  const i = C.plan_of[row * T + k], slot = C.driven[row * T + k];
  if (i < 0) return;
  const ego = slot === meta.ego && egoThere(k), n = meta.plan.points;
  pen.strokeStyle = pen.fillStyle = ego ? meta.colors.ego : meta.colors.driven;
  pen.lineWidth = ego ? 2.5 : 1.3;
  pen.globalAlpha = ego ? 0.85 : 0.8;
  pen.beginPath();
  for (let j = i * n; j < (i + 1) * n; j++) pen.lineTo(X(C.plan_x[j]), Y(C.plan_y[j]));
  pen.stroke();
  const size = Math.min(ego ? 3.2 : 2.2, 0.9 * view.scale);
  for (let j = i * n + meta.plan.per_second; j < (i + 1) * n; j += meta.plan.per_second) {
    pen.beginPath(); pen.arc(X(C.plan_x[j]), Y(C.plan_y[j]), size, 0, 7); pen.fill();
  }
  pen.globalAlpha = 1;
}
function trail(slot, from, to, now = null) {
  pen.beginPath();
  for (let j = from; j <= to; j++) pen.lineTo(X(C.x[slot * T + j]), Y(C.y[slot * T + j]));
  if (now) pen.lineTo(X(now.x), Y(now.y));
  pen.stroke();
}
const boost = () => Math.max(1, 8 / (4.6 * view.scale));
function body(p, i, grow) {  // in the axes of the vehicle, with its front corners cut
  const e = boost() * view.scale, l = C.length[i] * e / 2 + grow, w = C.width[i] * e / 2 + grow;
  pen.beginPath();
  pen.moveTo(-l, -w); pen.lineTo(0.72 * l, -w); pen.lineTo(l, -0.56 * w); pen.lineTo(l, 0.56 * w);
  pen.lineTo(0.72 * l, w); pen.lineTo(-l, w); pen.closePath();
  return [l, w];
}
function place(p) {
  const c = Math.cos(p.heading) * ratio, s = Math.sin(p.heading) * ratio;
  pen.setTransform(c, -s, s, c, X(p.x) * ratio, Y(p.y) * ratio);
}
const flat = () => pen.setTransform(ratio, 0, 0, ratio, 0, 0);

function drawVehicle(slot, p) {
  const i = slot * T + k, ego = slot === meta.ego && egoThere(k), hit = C.status[i] & 1, chosen = sel && sel.slot === slot;
  const outside = C.inside && on("interest") && !C.inside[i] && !ego;
  place(p);
  pen.lineJoin = "round";
  pen.globalAlpha = outside ? 0.45 : 1;
  const small = C.length[i] * boost() * view.scale < 24, driven = !ego && drivenAt(slot, k);
  if (driven) {
    body(p, i, small ? 1.5 : 2);
    pen.strokeStyle = meta.colors.driven; pen.lineWidth = small ? 2 : 3; pen.stroke();
  }
  if (chosen && !small) {
    body(p, i, driven ? 6 : 4);
    pen.strokeStyle = palette.accent; pen.lineWidth = 2.5; pen.stroke();
  }
  const [l, w] = body(p, i, 0);
  pen.fillStyle = ego ? meta.colors.ego : paint(i);
  pen.fill();
  pen.strokeStyle = hit ? meta.colors.collided : ego ? (palette.dark ? "#fff" : "#6d0c46") : palette.outline;
  pen.lineWidth = hit ? 2.8 : ego ? 1.4 : 0.7;
  pen.stroke();
  if (l > 9) {  // the windscreen shows where the front is
    pen.fillStyle = "#0008";
    pen.fillRect(0.28 * l, -0.78 * w, 0.22 * l, 1.56 * w);
  }
  if (C.a[i] < -1) {
    pen.fillStyle = "#ff2020";
    const deep = Math.max(1.8, 0.16 * l), wide = 0.62 * w;
    pen.shadowColor = "#ff2020"; pen.shadowBlur = l > 9 ? 6 * ratio : 0;
    pen.fillRect(-l - 0.5, -w, deep, wide);
    pen.fillRect(-l - 0.5, w - wide, deep, wide);
    pen.shadowBlur = 0;
  }
  flat();
  const x = X(p.x), y = Y(p.y);
  if (hit) {
    pen.strokeStyle = meta.colors.collided; pen.lineWidth = 2.8;
    pen.beginPath();
    const above = small ? y : y - 11 - Math.abs(Math.cos(p.heading)) * w - Math.abs(Math.sin(p.heading)) * l;
    for (const d of [1, -1]) { pen.moveTo(x - 6, above - 6 * d); pen.lineTo(x + 6, above + 6 * d); }
    pen.stroke();
  }
  if (small)  // seen from far off
    for (const [ring, color, r] of [[ego, meta.colors.ego, 12], [chosen, palette.accent, 15]])
      if (ring) {
        pen.strokeStyle = color; pen.lineWidth = 2;
        pen.beginPath(); pen.arc(x, y, r, 0, 7); pen.stroke();
      }
  pen.globalAlpha = 1;
}
function label(text, x, y, color, size = 11) {
  pen.font = `600 ${size}px system-ui, sans-serif`;
  pen.textAlign = "center"; pen.textBaseline = "middle";
  pen.lineWidth = 3; pen.strokeStyle = palette.panel; pen.lineJoin = "round";
  pen.strokeText(text, x, y);
  pen.fillStyle = color;
  pen.fillText(text, x, y);
}

let poses = [];
function draw() {
  poses = [];
  for (let slot = 0; slot < N; slot++) if (C.vehicle[slot * T + k]) poses[slot] = pose(slot, k, u);
  const there = sel && sel.first <= k && k <= sel.last;
  if (follow && there) {
    const p = poses[sel.slot];
    if (p.x !== view.x || p.y !== view.y) { view.x = p.x; view.y = p.y; mapDirty = true; }
  }
  if (mapDirty) drawMap();
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.drawImage(base, 0, 0);
  flat();
  pen.setLineDash([]);

  if (meta.interest && on("interest") && interestArea()) {
    pen.fillStyle = palette.accent + "1c"; pen.fill();
    pen.strokeStyle = palette.accent; pen.lineWidth = 1.5; pen.setLineDash([6, 4]); pen.stroke(); pen.setLineDash([]);
  }
  if (on("lights")) {
    pen.lineWidth = Math.min(Math.max(0.7 * view.scale, 2.5), 9);
    const bars = C.light_x.length / 2;
    for (let b = 0; b < bars; b++) {
      pen.strokeStyle = meta.colors.signals[C.light_state[b * T + k]];
      pen.beginPath();
      pen.moveTo(X(C.light_x[2 * b]), Y(C.light_y[2 * b]));
      pen.lineTo(X(C.light_x[2 * b + 1]), Y(C.light_y[2 * b + 1]));
      pen.stroke();
    }
  }
  if (on("trails")) {
    pen.strokeStyle = palette.ink; pen.globalAlpha = 0.35; pen.lineWidth = Math.max(1, 0.3 * view.scale);
    poses.forEach((p, slot) => {
      let from = k;
      while (from > 0 && times[k] - times[from] < 4 && C.vehicle[slot * T + from - 1] === C.vehicle[slot * T + k]) from--;
      trail(slot, from, k, p);
    });
    pen.globalAlpha = 1;
  }
  if (sel && on("path")) {
    pen.strokeStyle = palette.accent; pen.lineWidth = 1.5; pen.globalAlpha = 0.8;
    pen.setLineDash([2, 5]);
    trail(sel.slot, Math.max(sel.first, Math.min(k, sel.last)), sel.last);
    pen.setLineDash([]);
    trail(sel.slot, sel.first, Math.max(sel.first, Math.min(k, sel.last)), there ? poses[sel.slot] : null);
    pen.globalAlpha = 1;
  }
  if (meta.plan && on("plan")) for (let row = rows - 1; row >= 0; row--) drawPlan(row);  // the ego's on top
  const own = egoThere(k) ? meta.ego : null;
  const order = poses.map((p, slot) => slot).filter(slot => slot !== own && !(there && slot === sel.slot));
  if (there) order.push(sel.slot);
  if (own !== null && !(there && sel.slot === own)) order.push(own);
  order.forEach(slot => drawVehicle(slot, poses[slot]));
  if (sense && on("objects")) drawObjects();

  if (there) {
    const i = sel.slot * T + k, lead = C.lead[i];
    if (lead >= 0 && poses[lead]) {
      const p = poses[sel.slot], q = poses[lead], j = lead * T + k;
      const tip = (pose, half) => [X(pose.x + half * Math.cos(pose.heading)), Y(pose.y + half * Math.sin(pose.heading))];
      const a = tip(p, C.length[i] / 2), b = tip(q, -C.length[j] / 2);
      pen.strokeStyle = palette.accent; pen.lineWidth = 1.5; pen.setLineDash([4, 3]);
      pen.beginPath(); pen.moveTo(...a); pen.lineTo(...b); pen.stroke(); pen.setLineDash([]);
      if (Math.hypot(a[0] - b[0], a[1] - b[1]) > 44)
        label(`${C.gap[i].toFixed(1)} m`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, palette.accent);
    }
  }
  if (focus && Math.abs(t - focus.time) < 3 && focus.other !== null && poses[focus.other]) {
    const p = poses[focus.other], r = Math.max(14, 3.2 * view.scale);
    pen.strokeStyle = focus.color; pen.lineWidth = 2.5;
    pen.beginPath(); pen.arc(X(p.x), Y(p.y), r, 0, 7); pen.stroke();
    label(focus.label, X(p.x), Y(p.y) - r - 9, palette.ink, 12);
  }
  if (on("numbers") && view.scale > 5.5) {
    pen.textAlign = "center"; pen.textBaseline = "middle"; pen.lineJoin = "round";
    pen.font = `600 ${Math.min(15, 1.55 * view.scale)}px system-ui, sans-serif`;
    pen.strokeStyle = "#000b"; pen.fillStyle = "#fff"; pen.lineWidth = 2.5;
    poses.forEach((p, slot) => {
      pen.strokeText(String(slot), X(p.x), Y(p.y));
      pen.fillText(String(slot), X(p.x), Y(p.y));
    });
  }
}

