// What the reader does: choice of recording, methods, signals and joints; zoom, events, values under the pointer; the address.

const at = find(".at"), part = find(".part"), values = find(".values");
let waiting = false, ready = 0, current = null; // the event gone to last
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
}

async function open(index) {
  const chosen = content.recordings[index], mine = ++ready;
  const before = content.recordings.slice(0, index).reduce((sum, one) => sum + one.tiers.length, 0);
  const quanta = chosen.traces.map(([signal, , joint]) => content.quanta[signal][joint]);
  const starts = [0, chosen.windows.length ? chosen.windows[0][0] : 0];
  const tiers = await Promise.all(chosen.tiers.map((tier, k) => readTier(tier, texts[before + k].textContent, starts[k], quanta)));
  if (mine !== ready) return;
  Object.assign(state, { recording: index, from: 0, to: chosen.duration_s || 1 });
  view.tiers = tiers;
  picker.value = index;
}

function show(from, to) { // never outside the recording, never shorter than 20 samples
  const all = recording().duration_s || 1, span = Math.min(Math.max(to - from, recording().gap_s * 8), all);
  state.from = Math.min(Math.max((from + to - span) / 2, 0), all - span);
  state.to = state.from + span;
  current = null;
  hide();
  remember();
  redraw();
}
const zoom = (factor, around = (state.from + state.to) / 2) => show(around - (around - state.from) * factor, around + (state.to - around) * factor);
const move = (share) => show(state.from + share * (state.to - state.from), state.to + share * (state.to - state.from));

function events() {
  const found = recording().contacts.map(([a, b]) => ({ a, b, words: "contact" }));
  for (const [t, words] of recording().marks ?? []) found.push({ a: t, b: t, words });
  for (const m of methods())
    for (const [a, b, level] of recording().alarms[m.name])
      if (level === 2) {
        const touched = recording().contacts.some(([c, d]) => a >= c - 0.1 && a <= d + 0.3);
        found.push({ a, b, words: `alarm of ${m.label}${recording().contacts.length && !touched ? ", where no contact is labelled" : ""}` });
      }
  return found.sort((one, other) => one.a - other.a);
}

function go(direction) {
  const all = events(), span = state.to - state.from, whole = span >= (recording().duration_s || 1) * 0.999;
  const place = all.findIndex((e) => current && e.a === current.a && e.words === current.words);
  const here = whole ? (direction > 0 ? -1 : Infinity) : (state.from + state.to) / 2;
  const before = place >= 0 ? place : direction > 0 ? all.filter((e) => e.a <= here).length - 1 : all.filter((e) => e.a < here).length;
  const event = all[before + direction];
  if (!event) {
    message.textContent = all.length ? `No ${direction > 0 ? "later" : "earlier"} event in this recording.` : "This recording has no contact, and no alarm of the methods shown.";
    return;
  }
  const wide = whole || span > 4 ? 2 : span;
  show(event.a - wide / 2, event.a + wide / 2);
  current = event;
  message.textContent = `Event ${all.indexOf(event) + 1} of ${all.length}: ${event.words} at ${text(event.a, 3)} s${event.b > event.a ? `, for ${text(event.b - event.a, 3)} s` : ""}.`;
}

// Values of every visible trace of a joint at a time; a range where only buckets are kept.
function valuesAt(joint, t) {
  const inside = recording().windows.some(([a, b]) => t >= a && t <= b), tier = inside && view.tiers[1] ? view.tiers[1] : view.tiers[0];
  const { first, last } = tier.level(0);
  let k = Math.max(lowerBound(first, t + 1e-9) - 1, 0);
  if (k + 1 < first.length && t > last[k] && first[k + 1] - t < t - last[k]) k++;
  if (Math.abs(t - Math.min(Math.max(t, first[k]), last[k])) > recording().gap_s) return { time: t, lines: ["no samples: a gap"] };
  const lines = curves().filter((c) => c.joint === joint).reverse().map((c) => {
    const [low, high] = tier.trace(c.index, 0).map((v) => v[k]);
    const unit = content.units[c.joint];
    const number = Number.isNaN(low) ? "none" : high - low > 1e-12 ? `${text(low, 3)} to ${text(high, 3)} ${unit}` : `${text(low, 3)} ${unit}`;
    return `${BANDS[c.signal] ? `${c.signal === "limit" ? "threshold" : c.label} ±` : c.label}${c.method && methods().length > 1 ? ` (${c.method.label})` : ""}  ${number}`;
  });
  return { time: first[k], until: last[k], lines };
}

function hide() { at.style.display = values.style.display = part.style.display = "none"; }
function hover(x, y) {
  const row = view.rows.find((r) => y >= r.y && y <= r.y + r.height);
  if (!row || x < LEFT || x > canvas.clientWidth - RIGHT) return hide();
  const found = valuesAt(row.joint, view.t(x)), last = view.rows[view.rows.length - 1];
  Object.assign(at.style, { display: "block", left: `${x}px`, top: `${view.top}px`, height: `${last.y + last.height - view.top}px` });
  values.textContent = [`${content.joints[row.joint]} at ${text(found.time, 4)} s${found.until > found.time ? ` to ${text(found.until, 4)} s` : ""}`, ...found.lines].join("\n");
  values.style.display = "block";
  values.style.left = `${x + 14 + values.offsetWidth > canvas.clientWidth ? Math.max(x - 14 - values.offsetWidth, 0) : x + 14}px`;
  values.style.top = `${Math.min(y + 12, canvas.clientHeight - values.offsetHeight)}px`;
}

let drag = null;
canvas.addEventListener("pointerdown", (e) => {
  if (e.button > 1) return;
  const strip = e.offsetY <= STRIP;
  drag = { x: e.offsetX, from: state.from, to: state.to, what: strip ? "strip" : e.shiftKey || e.button === 1 || e.pointerType === "touch" ? "move" : "part" };
  canvas.setPointerCapture(e.pointerId);
  if (strip) toStrip(e.offsetX);
});
function toStrip(x) {
  const half = (state.to - state.from) / 2;
  show(view.strip(x) - half, view.strip(x) + half);
}
canvas.addEventListener("pointermove", (e) => {
  if (!drag) return hover(e.offsetX, e.offsetY);
  if (drag.what === "strip") return toStrip(e.offsetX);
  if (drag.what === "move") {
    const moved = ((drag.x - e.offsetX) / (canvas.clientWidth - LEFT - RIGHT)) * (drag.to - drag.from);
    return show(drag.from + moved, drag.to + moved);
  }
  const a = Math.max(Math.min(drag.x, e.offsetX), LEFT), b = Math.min(Math.max(drag.x, e.offsetX), canvas.clientWidth - RIGHT);
  Object.assign(part.style, { display: "block", left: `${a}px`, width: `${Math.max(b - a, 0)}px`, top: `${view.top}px`, height: `${view.bottom - view.top}px` });
});
canvas.addEventListener("pointerup", (e) => {
  if (drag && drag.what === "part" && Math.abs(e.offsetX - drag.x) > 4) {
    const [a, b] = [drag.x, e.offsetX].sort((p, q) => p - q).map((x) => Math.min(Math.max(view.t(x), state.from), state.to));
    show(a, b);
  }
  drag = null;
});
canvas.addEventListener("pointercancel", () => { drag = null; hide(); });
canvas.addEventListener("pointerleave", hide);
canvas.addEventListener("dblclick", (e) => { if (e.offsetY > STRIP) show(0, Infinity); });
canvas.addEventListener("wheel", (e) => {
  if (!e.ctrlKey && !e.metaKey && document.activeElement !== canvas) return;
  e.preventDefault();
  const unit = e.deltaMode === 1 ? 16 : 1;
  if (Math.abs(e.deltaX) > Math.abs(e.deltaY)) move((e.deltaX * unit) / 1000);
  else zoom(Math.exp(Math.min(Math.max(e.deltaY * unit, -240), 240) * 0.0025), view.t(Math.max(e.offsetX, LEFT)));
}, { passive: false });

const deeds = { next: () => go(1), previous: () => go(-1), in: () => zoom(0.5), out: () => zoom(2), whole: () => show(0, Infinity), left: () => move(-0.25), right: () => move(0.25) };
const keys = { n: "next", p: "previous", "+": "in", "=": "in", "-": "out", "−": "out", 0: "whole", Home: "whole", ArrowLeft: "left", ArrowRight: "right" };
canvas.addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.metaKey || e.altKey) return;
  if (e.key === "Escape") canvas.blur();
  if (!keys[e.key]) return;
  e.preventDefault();
  deeds[keys[e.key]]();
});
for (const button of root.querySelectorAll("[data-do]")) button.addEventListener("click", () => deeds[button.dataset.do]());

function boxes(kind, entries) { // a check box each, and a sample of the line where it has one
  const place = find(`[data-of=${kind}]`);
  for (const { key, label, colour, width } of entries) {
    const box = document.createElement("input"), line = document.createElement("i"), whole = document.createElement("label");
    Object.assign(box, { type: "checkbox", value: key, checked: state[kind].has(key) });
    Object.assign(line.style, { background: colour ?? "#333", height: `${width ?? 3}px` });
    whole.append(box, ...(colour || width ? [line] : " "), label);
    place.append(whole);
    box.addEventListener("change", () => { state[kind][box.checked ? "add" : "delete"](key); hide(); remember(); redraw(); });
  }
}
function tick() {
  for (const kind of ["signals", "methods", "joints"])
    for (const box of find(`[data-of=${kind}]`).querySelectorAll("input")) box.checked = state[kind].has(kind === "joints" ? +box.value : box.value);
}

// The address: #recording=..&t=from,to&joint=..&method=..&signal=..; what it leaves out stays as it is.
function remember() {
  const words = new URLSearchParams({ recording: recording().name, t: `${state.from.toFixed(4)},${state.to.toFixed(4)}` });
  for (const joint of state.joints) words.append("joint", content.joints[joint]);
  for (const method of state.methods) words.append("method", method);
  for (const signal of state.signals) words.append("signal", signal);
  try { history.replaceState(null, "", `#${words}`); } catch { /* some browsers count calls; the next one does it */ }
}
async function follow() {
  const words = new URLSearchParams(location.hash.slice(1)), unknown = [];
  const name = words.get("recording"), index = content.recordings.findIndex((one) => one.name === name);
  if (name === null) return false;
  if (index < 0) unknown.push(`recording '${name}'`);
  await open(Math.max(index, 0));
  const choose = (kind, word, known) => {
    if (!words.has(word)) return;
    const found = words.getAll(word).map((one) => [one, known(one)]);
    unknown.push(...found.filter(([, key]) => key === undefined).map(([one]) => `${word} '${one}'`));
    state[kind] = new Set(found.map(([, key]) => key).filter((key) => key !== undefined));
  };
  choose("joints", "joint", (one) => (content.joints.includes(one) ? content.joints.indexOf(one) : undefined));
  choose("methods", "method", (one) => content.methods.find((m) => m.name === one)?.name);
  choose("signals", "signal", (one) => (SIGNALS[one] ? one : undefined));
  tick();
  const [from, to] = (words.get("t") ?? "").split(",").map(Number);
  if (from < to && index >= 0) show(from, to);
  message.textContent = unknown.length ? `The address names ${unknown.join(", ")}, not on this page.` : "";
  root.scrollIntoView();
  redraw();
  return true;
}

async function start() {
  for (const [k, one] of content.recordings.entries()) {
    const touches = one.contacts.length ? `, ${one.contacts.length} contact${one.contacts.length > 1 ? "s" : ""}` : "";
    picker.add(new Option(`${one.name} (${text(one.duration_s, 1)} s${touches})`, k));
  }
  state.joints = new Set(content.joints.keys());
  state.methods = new Set(content.methods.filter((m) => m.on).map((m) => m.name));
  const held = new Set(content.recordings.flatMap((one) => one.traces.map(([signal]) => signal)));
  boxes("signals", Object.entries(SIGNALS).filter(([key]) => held.has(key)).map(([key, s]) => ({ key, label: s.label, width: s.width + 0.7, colour: s.colour ?? shaded("#0072b2", s.shade) })));
  boxes("methods", content.methods.map((m) => ({ key: m.name, label: m.label, colour: m.colour })));
  boxes("joints", content.joints.map((label, key) => ({ key, label })));
  picker.addEventListener("change", async () => { await open(+picker.value); message.textContent = ""; remember(); redraw(); });
  window.addEventListener("hashchange", follow);
  new ResizeObserver(redraw).observe(canvas.parentElement);
  if (!(await follow())) await open(0);
  draw();
  root.dataset.ready = "yes";
}
window.tauextTraces = { content, state, view, show, valuesAt };
start().catch((error) => { message.textContent = `The traces cannot be shown: ${error.message}. A browser of 2023 or later is needed.`; });
