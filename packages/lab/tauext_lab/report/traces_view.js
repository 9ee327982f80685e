// The plot: one row a joint over a shared time axis, drawn on one canvas from Tiers (traces_data.js).

const root = document.getElementById("traces"), find = (what) => root.querySelector(what);
const content = JSON.parse(document.getElementById("traces-content").textContent);
const texts = [...root.querySelectorAll(".traces-data")];
const canvas = find("canvas"), message = find(".message"), picker = document.getElementById("traces-recording");
const SIGNALS = {
  tau_ext: { label: "external torque", width: 1.3, shade: 0 },
  limit: { label: "thresholds", width: 1, shade: 0.35 },
  sigma: { label: "standard error", width: 0.8, shade: 0.5 },
  r: { label: "observer r", width: 2.6, shade: 0.6 },
  learned: { label: content.learned, width: 1.1, shade: -0.35 },
  reference: { label: "reference", width: 1, colour: "#000000" },
  tau: { label: "motor torque", width: 0.9, colour: "#7a7a7a" },
};
const ORDER = ["tau", "r", "limit", "sigma", "reference", "learned", "tau_ext"]; // from below
const BANDS = { limit: "#f1f6fa", sigma: "#dbe8f2" }; // signals that stand on both sides of zero, and what is between
const HEALTH_COLOUR = "#ececec", GAP_COLOUR = "#c4c4c4", CONTACT_COLOUR = "#fbe3cf", MARK_COLOUR = "#d55e00";
const LEFT = 74, RIGHT = 8, STRIP = 20, LANE = 11, AXIS = 34, SPACE = 9;
const state = { recording: 0, from: 0, to: 1, methods: new Set(), signals: new Set(["tau_ext", "limit", "sigma"]), joints: new Set() };
const view = { rows: [], lanes: [], tiers: null, drawn: {}, ms: 0 };
const recording = () => content.recordings[state.recording];
const methods = () => content.methods.filter((m) => state.methods.has(m.name) && recording().alarms[m.name]);

function shaded(colour, share) { // towards white, or black where negative
  const to = share < 0 ? 0 : 255;
  return "#" + [1, 3, 5].map((k) => Math.round(parseInt(colour.slice(k, k + 2), 16) * (1 - Math.abs(share)) + to * Math.abs(share)).toString(16).padStart(2, "0")).join("");
}

function curves() { // traces to be drawn, those on top last
  const known = new Map(recording().traces.map(([signal, method, joint], k) => [`${signal} ${joint} ${method ?? ""}`, k]));
  const found = [];
  for (const signal of ORDER.filter((s) => state.signals.has(s)))
    for (const method of SIGNALS[signal].colour ? [null] : methods().slice().reverse())
      for (const joint of content.joints.keys()) {
        const index = known.get(`${signal} ${joint} ${method ? method.name : ""}`);
        if (index !== undefined && state.joints.has(joint))
          found.push({ signal, method, joint, index, ...SIGNALS[signal], colour: SIGNALS[signal].colour ?? shaded(method.colour, SIGNALS[signal].shade) });
      }
  return found;
}

// Stretches of the window with the tier that is drawn there: every sample where it is kept, and needed.
function pieces(pixels) {
  const { from, to } = state, [whole, close] = view.tiers, found = [];
  let at = from;
  const [a, b] = whole.range(0, from, to);
  const half = recording().gap_s / 5; // of a sample's period: what belongs to a window is not drawn twice
  if (close && b - a < 2 * pixels)
    for (const [begin, end] of recording().windows) {
      if (end < from || begin > to) continue;
      if (begin > at) found.push([whole, at, begin - half]);
      found.push([close, Math.max(begin, from), Math.min(end, to)]);
      at = end + half;
    }
  if (at < to) found.push([whole, at, to]);
  return found;
}

// Lowest and highest value a pixel column of one trace, in its joint's unit; or its samples, where they are wide apart.
function columns(curve, parts, pixels) {
  const low = new Float32Array(pixels).fill(Infinity), high = new Float32Array(pixels).fill(-Infinity), lines = [], soft = new Uint8Array(pixels);
  const scale = pixels / (state.to - state.from), x = (t) => (t - state.from) * scale;
  const gap = recording().gap_s;
  let least = Infinity, most = -Infinity;
  for (const [tier, from, to] of parts) {
    const k = tier.levelFor(from, to, 4 * pixels), { first, last } = tier.level(k);
    const [lows, highs] = tier.trace(curve.index, k);
    const [a, b] = tier.range(k, from, to), sparse = tier.size === 1 && k === 0 && b - a < x(to) - x(from) + 2;
    for (let i = a; i < b; i++) {
      const inside = first[i] <= to && last[i] >= from;
      if (Number.isNaN(lows[i]) || !(inside || sparse)) continue;
      if (inside && lows[i] < least) least = lows[i];
      if (inside && highs[i] > most) most = highs[i];
      if (sparse) {
        if (i === a || first[i] - last[i - 1] > gap || Number.isNaN(lows[i - 1])) lines.push([]);
        lines[lines.length - 1].push(x(first[i]), lows[i]);
        continue;
      }
      const end = Math.min(i + 1 < b && first[i + 1] - last[i] <= gap ? first[i + 1] : last[i], to);
      const c0 = Math.max(Math.floor(x(first[i])), 0), c1 = Math.min(Math.floor(x(end)), pixels - 1);
      for (let c = c0; c <= c1; c++) {
        if (c1 - c0 > 3) soft[c] = 1; // no more is known than the range
        if (lows[i] < low[c]) low[c] = lows[i];
        if (highs[i] > high[c]) high[c] = highs[i];
      }
    }
  }
  return { ...curve, low, high, lines, soft, least, most };
}

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}
const text = (value, digits) => value.toFixed(digits).replace("-", "−");

function draw() {
  if (!view.tiers) return;
  const began = performance.now(), ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
  const shown = [...content.joints.keys()].filter((j) => state.joints.has(j)), lanes = methods();
  const height = shown.length <= 2 ? 200 : shown.length <= 3 ? 170 : 116;
  const top = STRIP + 8 + lanes.length * LANE + 6, total = top + shown.length * (height + SPACE) + AXIS;
  canvas.style.height = `${total}px`;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(total * ratio);
  const g = canvas.getContext("2d"), pixels = Math.max(Math.round((width - LEFT - RIGHT) * ratio), 1);
  g.scale(ratio, ratio);
  g.font = "12px system-ui, sans-serif";
  g.textBaseline = "middle";
  view.x = (t) => LEFT + ((t - state.from) / (state.to - state.from)) * (width - LEFT - RIGHT);
  view.t = (x) => state.from + ((x - LEFT) / (width - LEFT - RIGHT)) * (state.to - state.from);
  view.top = top;
  const bottom = top + shown.length * (height + SPACE) - SPACE;
  const bars = (stretches, y, h, colour, x = view.x, least = 1.5) => {
    g.fillStyle = colour;
    for (const [a, b] of stretches) {
      const from = Math.max(x(a), LEFT), to = Math.min(x(b), width - RIGHT);
      if (to >= LEFT && from <= width - RIGHT) g.fillRect(from, y, Math.max(to - from, least), h);
    }
  };
  const all = recording(), span = all.duration_s || 1, strip = (t) => LEFT + (t / span) * (width - LEFT - RIGHT);
  view.strip = (x) => ((x - LEFT) / (width - LEFT - RIGHT)) * span;
  // All of the recording, with the window in it.
  g.fillStyle = "#f6f6f6";
  g.fillRect(LEFT, 0, width - LEFT - RIGHT, STRIP);
  bars(all.contacts, 0, STRIP, "#f0b98a", strip);
  bars(all.gaps, 0, STRIP, GAP_COLOUR, strip);
  lanes.forEach((m, k) => bars(all.alarms[m.name], (STRIP * k) / lanes.length, STRIP / lanes.length, m.colour, strip));
  g.strokeStyle = "#1c1c1c";
  g.strokeRect(strip(state.from) + 0.5, 0.5, Math.max(strip(state.to) - strip(state.from) - 1, 2), STRIP - 1);
  g.textAlign = "right";
  g.fillStyle = "#5a5a5a";
  g.fillText("recording", LEFT - 6, STRIP / 2);
  // Alarms, a lane a method: collisions full, contacts half as high.
  lanes.forEach((m, k) => {
    const y = STRIP + 8 + k * LANE;
    g.fillStyle = "#f6f6f6";
    g.fillRect(LEFT, y, width - LEFT - RIGHT, LANE - 2);
    bars(all.unhealthy[m.name], y, LANE - 2, GAP_COLOUR);
    bars(all.alarms[m.name].filter((one) => one[2] === 1), y + 2.5, LANE - 7, m.colour);
    bars(all.alarms[m.name].filter((one) => one[2] === 2), y, LANE - 2, m.colour, view.x, 2.5);
  });
  g.fillStyle = "#5a5a5a";
  if (lanes.length) g.fillText("alarms", LEFT - 6, STRIP + 8 + (lanes.length * LANE) / 2);
  const parts = pieces(pixels), drawn = curves().map((curve) => columns(curve, parts, pixels));
  view.rows = shown.map((joint, place) => drawRow(g, joint, top + place * (height + SPACE), height, width, pixels, ratio, drawn, bars));
  const [times, digits] = ticks(state.from, state.to, Math.max(Math.floor(width / 130), 2));
  g.fillStyle = "#333333";
  g.textAlign = "center";
  for (const t of times) {
    g.fillRect(view.x(t), bottom, 1, 4);
    g.fillText(text(t, digits), view.x(t), bottom + 12);
  }
  g.fillText("time, s", (LEFT + width - RIGHT) / 2, bottom + 27);
  view.bottom = bottom;
  view.curves = drawn;
  view.drawn = Object.fromEntries(drawn.map((c) => [`${c.signal} ${content.joints[c.joint]} ${c.method ? c.method.name : ""}`.trim(), [c.least, c.most]]));
  view.ms = performance.now() - began;
}

function drawRow(g, joint, y, height, width, pixels, ratio, drawn, bars) {
  const mine = drawn.filter((c) => c.joint === joint), plot = width - LEFT - RIGHT;
  let least = Infinity, most = -Infinity;
  for (const c of mine) {
    least = Math.min(least, BANDS[c.signal] ? -c.most : c.least);
    most = Math.max(most, c.most);
  }
  if (!(least <= most)) [least, most] = [-1, 1];
  const leastSpan = content.quanta_a_row * Math.max(...mine.map((c) => content.quanta[c.signal][joint]), 0);
  const missing = leastSpan - (most - least) * 1.1, margin = Math.max((most - least) * 0.05, 0) + Math.max(missing, 0) / 2;
  [least, most] = [least - margin, most + margin];
  const at = (value) => y + height - ((value - least) / (most - least)) * height, top = (a) => Math.min(Math.max(at(a), y - 5), y + height + 5);
  const first = methods()[0];
  g.save();
  g.beginPath();
  g.rect(LEFT, y, plot, height);
  g.clip();
  g.fillStyle = "#ffffff";
  g.fillRect(LEFT, y, plot, height);
  for (const c of mine.filter((c) => BANDS[c.signal] && c.method === first)) fillBand(g, c, at, pixels, ratio);
  if (first) bars(recording().unhealthy[first.name], y, height, HEALTH_COLOUR);
  g.globalAlpha = 0.8;
  bars(recording().contacts, y, height, CONTACT_COLOUR);
  g.globalAlpha = 1;
  bars(recording().gaps, y, height, GAP_COLOUR);
  g.fillStyle = "#e3e3e3";
  const [marks, digits] = ticks(least, most, height / 28);
  for (const v of marks) g.fillRect(LEFT, at(v), plot, v === 0 ? 1.5 : 0.7);
  for (const m of methods()) // where an alarm begins
    for (const one of recording().alarms[m.name])
      if (one[2] === 2 && one[0] >= state.from && one[0] <= state.to) {
        g.fillStyle = m.colour;
        g.beginPath();
        for (const [dx, dy] of [[-4, 0], [4, 0], [0, 7]]) g.lineTo(view.x(one[0]) + dx, y + dy);
        g.fill();
      }
  bars((recording().marks ?? []).map(([t]) => [t, t]), y, height, MARK_COLOUR, view.x, 1);
  for (const c of mine) {
    drawCurve(g, c, at, top, pixels, ratio, 1);
    if (BANDS[c.signal]) drawCurve(g, c, at, top, pixels, ratio, -1);
  }
  g.restore();
  g.strokeStyle = "#8a8a8a";
  g.lineWidth = 0.7;
  g.strokeRect(LEFT, y, plot, height);
  g.fillStyle = "#333333";
  g.textAlign = "right";
  for (const v of marks) g.fillText(text(v, digits), LEFT - 5, Math.min(Math.max(at(v), y + 5), y + height - 4));
  g.save();
  g.translate(9, y + height / 2);
  g.rotate(-Math.PI / 2);
  g.textAlign = "center";
  g.fillText(`${content.joints[joint]}, ${content.units[joint]}`, 0, 0, height - 4);
  g.restore();
  return { joint, y, height, least, most };
}

function fillBand(g, c, at, pixels, ratio) {
  g.fillStyle = BANDS[c.signal];
  for (const [from, to] of runs(c, pixels)) g.fillRect(LEFT + from / ratio, at(c.low[from]), (to - from) / ratio, at(-c.low[from]) - at(c.low[from]));
  for (const line of c.lines) {
    g.beginPath();
    for (let k = 0; k < line.length; k += 2) g.lineTo(LEFT + line[k] / ratio, at(line[k + 1]));
    for (let k = line.length - 2; k >= 0; k -= 2) g.lineTo(LEFT + line[k] / ratio, at(-line[k + 1]));
    g.fill();
  }
}

function drawCurve(g, c, at, top, pixels, ratio, sign) {
  g.fillStyle = g.strokeStyle = c.colour;
  g.lineWidth = c.width;
  g.lineJoin = "round";
  for (const line of c.lines) {
    g.beginPath();
    for (let k = 0; k < line.length; k += 2) g.lineTo(LEFT + line[k] / ratio, at(sign * line[k + 1]));
    if (line.length === 2) g.rect(LEFT + line[0] / ratio - 0.5, at(sign * line[1]) - 0.5, 1, 1);
    g.stroke();
  }
  for (const [from, to] of runs(c, pixels)) {
    const low = c.low[from], high = c.high[from], x = LEFT + from / ratio, wide = (to - from) / ratio;
    const [a, b] = sign > 0 ? [top(high), top(low)] : [top(-low), top(-high)];
    if (from && c.low[from - 1] <= c.high[from - 1]) { // up to its neighbour, so that the curve is one
      const [least, most] = [Math.min(low, c.high[from - 1]), Math.max(high, c.low[from - 1])];
      const [above, below] = sign > 0 ? [top(most), top(least)] : [top(-least), top(-most)];
      if (above < a) g.fillRect(x, above, 1 / ratio, a - above);
      if (below > b) g.fillRect(x, b, 1 / ratio, below - b);
    }
    if (c.soft[from] && b - a > 3) { // a box between its lowest and highest value
      g.globalAlpha = 0.3;
      g.fillRect(x, a, wide, b - a);
      g.globalAlpha = 1;
      g.fillRect(x, a - c.width / 2, wide, c.width);
      g.fillRect(x, b - c.width / 2, wide, c.width);
    } else g.fillRect(x, a - c.width / 2, wide, b - a + c.width);
  }
}

function runs(c, pixels) { // stretches [from, to) of columns that are alike, holes left out
  const found = [];
  for (let k = 0, end; k < pixels; k = end) {
    for (end = k + 1; end < pixels && c.low[end] === c.low[k] && c.high[end] === c.high[k] && c.soft[end] === c.soft[k]; ) end++;
    if (c.low[k] <= c.high[k]) found.push([k, end]);
  }
  return found;
}
