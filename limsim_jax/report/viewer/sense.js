// --- what the ego senses: cameras, point cloud, bird's-eye view -----------------------------------

const sense = meta.sense;
const board = {};  // canvases of pictures in their own pixels, by name
let shot = -1, lit = true;
const shotAt = time => Math.max(0, lastAt(C.sense_time, time));
function pixels(name, w, h, colors, at) {  // indices of colours as a canvas
  const own = board[name] ||= Object.assign(document.createElement("canvas"), {width: w, height: h});
  const ctx = own.getContext("2d"), image = board[name + " data"] ||= ctx.createImageData(w, h);
  const words = new Uint32Array(image.data.buffer);
  for (let i = 0; i < w * h; i++) words[i] = colors[at[i]];
  ctx.putImageData(image, 0, 0);
  return own;
}
const packed = colors => Uint32Array.from(colors, ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0);
if (sense) {
  if (sense.cameras) sense.cameras.words = packed(sense.cameras.palette);
  sense.raster.words = packed(sense.raster.palette);
  const shares = {cameras: 0, lidar: sense.lidar ? 1 : 0, bev: 2 * sense.raster.side / (sense.raster.ahead + sense.raster.behind)};
  if (sense.cameras) {
    const {grid, width: w, height: h} = sense.cameras;
    shares.cameras = grid[0] * w / h / grid[1];
  }
  for (const [name, share] of Object.entries(shares)) {
    $(name).hidden = !share;
    $(name).style.aspectRatio = String(share || 1);
  }
  $("sense").style.setProperty("--shares", String(shares.cameras + shares.lidar + shares.bev));
  document.body.classList.add("senses");
  $("sensing").hidden = $("sense").hidden = false;
}
function setSensing(value) {
  lit = value;
  $("sense").hidden = !value;
  document.body.classList.toggle("senses", value);
  $("sensing").setAttribute("aria-pressed", String(value));
  shot = -1;
  dirty = true;
}
function paper(name) {  // the canvas in pixels of the screen; its pen draws in those of the page
  const own = $(name), w = own.clientWidth, h = own.clientHeight;
  if (own.width !== Math.round(w * ratio) || own.height !== Math.round(h * ratio)) {
    own.width = Math.round(w * ratio); own.height = Math.round(h * ratio);
  }
  const ctx = own.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.imageSmoothingEnabled = false;
  return [ctx, w, h];
}
function tag(ctx, x, y, text, room) {
  ctx.font = "11px system-ui, sans-serif"; ctx.textAlign = "left"; ctx.textBaseline = "top";
  text = [text, text.split(",")[0], text.split(" ")[0]].find(x => ctx.measureText(x).width + 8 <= room) ?? "";
  if (!text) return;
  ctx.fillStyle = "#ffffffcc"; ctx.fillRect(x, y, ctx.measureText(text).width + 8, 16);
  ctx.fillStyle = "#2f3742"; ctx.fillText(text, x + 4, y + 2.500);
}
/** Each entry of the object list: corners in the frame of the ego, whether it is real, and its way in a second. */
function* listed(f) {
  for (let d = 0; d < sense.objects; d++) {
    const i = d * sense.frames + f;
    if (!C.object_there[i]) continue;
    const x = C.object_x[i], y = C.object_y[i], c = Math.cos(C.object_heading[i]), s = Math.sin(C.object_heading[i]);
    const l = C.object_length[i] / 2, w = C.object_width[i] / 2;
    const corners = [[l, w], [-l, w], [-l, -w], [l, -w]].map(([a, b]) => [x + c * a - s * b, y + s * a + c * b]);
    yield [corners, C.object_id[i] >= 0, [x, y, x + C.object_vx[i], y + C.object_vy[i]]];
  }
}
function boxes(ctx, f, to, real, made) {
  ctx.lineWidth = 1.5;
  for (const [corners, true_, way] of listed(f)) {
    ctx.strokeStyle = true_ ? real : made;
    ctx.setLineDash(true_ ? [] : [3, 2]);
    ctx.beginPath();
    corners.forEach(([x, y]) => ctx.lineTo(...to(x, y)));
    ctx.closePath();
    ctx.moveTo(...to(way[0], way[1])); ctx.lineTo(...to(way[2], way[3]));
    ctx.stroke();
  }
  ctx.setLineDash([]);
}
function own(ctx, to, color) {
  const [l, w] = sense.size.map(x => x / 2);
  ctx.fillStyle = color;
  ctx.beginPath();
  for (const [x, y] of [[l, w], [-l, w], [-l, -w], [l, -w]]) ctx.lineTo(...to(x, y));
  ctx.fill();
}
function drawSense() {
  if (!sense || !lit) return;
  const f = shotAt(t), size = `${$("sense").clientWidth} ${$("sense").clientHeight} ${ratio}`;
  const gone = t > C.sense_time[sense.frames - 1] + 1 && !egoThere(k);
  $("sense").classList.toggle("gone", gone);
  if (f === shot && size === shown.senseSize) return;
  shot = f; shown.shot = f; shown.senseSize = size;
  if (sense.cameras) {
    const {names, width: w, height: h, grid: [across, down], words} = sense.cameras, [ctx, wide, high] = paper("cameras");
    ctx.clearRect(0, 0, wide, high);
    names.forEach((name, c) => {
      const from = (c * sense.frames + f) * w * h, x = (c % across) * wide / across, y = Math.floor(c / across) * high / down;
      ctx.drawImage(pixels("picture", w, h, words, B.pictures.subarray(from, from + w * h)), x, y, wide / across - 1.5, high / down - 1.5);
      tag(ctx, x, y, name, wide);
    });
  }
  if (sense.lidar) {
    const {x: x0, y: y0, elevations, columns, unit} = sense.lidar, [ctx, wide, high] = paper("lidar");
    const scale = high / 2 / sense.reach, to = (x, y) => [wide / 2 - scale * y, high / 2 - scale * x];
    ctx.fillStyle = sense.colors.night;
    ctx.fillRect(0, 0, wide, high);
    const rays = elevations.length * columns, plane = rays * sense.frames;
    let points = 0;
    for (const struck of [false, true]) {
      ctx.fillStyle = struck ? sense.colors.body : sense.colors.ground;
      const size = struck ? 1.8 : 1;
      for (let i = 0; i < rays; i++) {
        const code = B.ranges[f * rays + i] | B.ranges[plane + f * rays + i] << 8;
        if (!code || (code >= 32768) !== struck) continue;
        points++;
        const away = unit * (code & 32767) * Math.cos(elevations[Math.floor(i / columns)]), turn = 2 * Math.PI * (i % columns) / columns;
        const [x, y] = to(x0 + away * Math.cos(turn), y0 + away * Math.sin(turn));
        ctx.fillRect(x - size / 2, y - size / 2, size, size);
      }
    }
    boxes(ctx, f, to, sense.colors.found, sense.colors.false);
    own(ctx, to, "#ffffff");
    tag(ctx, 0, 0, `LiDAR, ${points.toLocaleString("en")} points`, wide);
    shown.points = points;
  }
  const {ahead, behind, shape: [down, across], words} = sense.raster, [ctx, wide, high] = paper("bev");
  const scale = high / (ahead + behind), to = (x, y) => [wide / 2 - scale * y, scale * (ahead - x)];
  ctx.drawImage(pixels("raster", across, down, words, B.bev.subarray(f * across * down, (f + 1) * across * down)), 0, 0, wide, high);
  boxes(ctx, f, to, sense.colors.found_by_day, sense.colors.false_by_day);
  own(ctx, to, "#2f3742");
  tag(ctx, 0, 0, `bird's-eye view, ${C.sense_time[f].toFixed(1)} s`, wide);
}
/** The object list above the map, where the ego believes the objects to be. */
function drawObjects() {
  const f = shotAt(t);
  if (!egoThere(k) || t - C.sense_time[f] > 5) return;
  const c = Math.cos(C.sense_heading[f]), s = Math.sin(C.sense_heading[f]);
  const to = (x, y) => [X(C.sense_x[f] + c * x - s * y), Y(C.sense_y[f] + s * x + c * y)];
  const {found, found_by_day, false: made, false_by_day} = sense.colors;
  boxes(pen, f, to, palette.dark ? found : found_by_day, palette.dark ? made : false_by_day);
}
