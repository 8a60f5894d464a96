// Rates, latencies, the map of interventions, the timeline of processes.

function whiskers(root) {
  for (const cell of root.querySelectorAll("td.whisker")) {
    const { rate, low, high } = cell.dataset;
    if (rate === "") continue;
    const most = Math.max(+high || 0, +rate) > 0.2 ? 1 : Math.max(+high || 0, +rate, 1e-9) * 1.15;
    const x = scale(0, most, 4, 256);
    const parts = [tag("line", { x1: 4, x2: 256, y1: 10, y2: 10, stroke: "#dfe4ea", "stroke-width": 2 })];
    if (low !== "") parts.push(tag("line", { x1: x(+low), x2: x(+high), y1: 10, y2: 10, stroke: "#2b6cb8", "stroke-width": 5, "stroke-linecap": "round", opacity: 0.35 }));
    parts.push(tag("circle", { cx: x(+rate), cy: 10, r: 4, fill: "#2b6cb8" }));
    parts.push(label(310, 14, `of ${percent(most)}`, { "text-anchor": "end" }));
    cell.innerHTML = drawing(312, 20, `${percent(+rate)}, interval ${percent(+low)} to ${percent(+high)}`, parts);
  }
}

function latency(target, kinds) {
  const parts = ["round_trip", "network", "queue", "decide", "solve", "verify"];
  const buttons = element("div", { class: "bar", role: "group", "aria-label": "part of the time" });
  const place = element("div");
  const show = (part) => {
    for (const button of buttons.children) button.setAttribute("aria-pressed", String(button.dataset.part === part));
    place.innerHTML = "";
    place.append(bars(kinds, part));
  };
  for (const part of parts) buttons.append(element("button", { "data-part": part, onclick: () => show(part) }, part.replace("_", " ")));
  target.append(buttons, place);
  show("round_trip");
}

function bars(kinds, part) {
  const rows = Object.entries(KINDS).filter(([, k]) => kinds[k.name]?.[part]?.length).map(([, k]) => [k, kinds[k.name][part]]);
  if (!rows.length) return nothing("The log has no such measurement.");
  const frame = { left: 56, right: 1030, top: 12, bottom: 60 };
  const low = Math.min(...rows.map(([, b]) => b[0][0])), high = Math.max(...rows.map(([, b]) => b.at(-1)[1]));
  const x = scale(Math.log(low), Math.log(high), frame.left, frame.right), at = (v) => x(Math.log(v));
  const marks = [];
  for (let p = Math.floor(Math.log10(low)); p <= Math.log10(high); p++) for (const m of [1, 2, 5]) marks.push(m * 10 ** p);
  const height = 62, out = [];
  rows.forEach(([kind, given], k) => {
    const base = frame.top + (k + 1) * height, most = Math.max(...given.map((b) => b[2]));
    out.push(label(frame.left - 6, base - 4, kind.name, { "text-anchor": "end" }));
    for (const [from, to, count] of given) {
      const tall = count ? Math.max(1.2, (height - 12) * count / most) : 0;
      out.push(tag("rect", { x: at(from), y: base - tall, width: Math.max(0.5, at(to) - at(from) - 1), height: tall, fill: kind.color }, tag("title", {}, `${figure(from)} to ${figure(to)} ms: ${count}`)));
    }
    out.push(tag("line", { x1: frame.left, x2: frame.right, y1: base, y2: base, class: "axis" }));
  });
  const bottom = frame.top + rows.length * height;
  for (const v of marks.filter((v) => v >= low && v <= high)) out.push(label(at(v), bottom + 16, figure(v), { "text-anchor": "middle" }), tag("line", { x1: at(v), x2: at(v), y1: bottom, y2: bottom + 4, class: "axis" }));
  out.push(label(frame.right, bottom + 32, "ms, logarithmic; each kind has its own vertical scale", { "text-anchor": "end" }));
  const box = element("div");
  box.innerHTML = drawing(1040, bottom + 38, `latency of decisions, ${part}`, out, { "data-part": part });
  saves(box, `latency, ${part}`, () => rows.flatMap(([kind, given]) => given.map(([from, to, count]) => ({ decision: kind.name, from_ms: from, to_ms: to, count }))));
  return box;
}

/** White to amber to red; also readable in grey. */
function heat(share) {
  const stops = [[240, 244, 248], [250, 206, 120], [224, 120, 20], [160, 30, 24]];
  const at = Math.min(0.999, Math.max(0, share)) * 3, k = Math.floor(at), f = at - k;
  return `rgb(${stops[k].map((v, i) => Math.round(v + f * (stops[k + 1][i] - v))).join(",")})`;
}

/** One map: the color shows `value(cell)` between 0 and `most`; `form` formats a value. */
function map(cells, cell, what, value, most, form) {
  const xs = cells.map((c) => c[0]), ys = cells.map((c) => c[1]);
  const box = { x0: Math.min(...xs) * cell, x1: (Math.max(...xs) + 1) * cell, y0: Math.min(...ys) * cell, y1: (Math.max(...ys) + 1) * cell };
  const per = 400 / Math.max(box.x1 - box.x0, box.y1 - box.y0);
  const frame = { left: 36, top: 26, right: 36 + per * (box.x1 - box.x0), bottom: 26 + per * (box.y1 - box.y0) };
  const x = (v) => frame.left + per * (v - box.x0), y = (v) => frame.bottom - per * (v - box.y0);
  const out = [label(4, 14, what, { class: "title" })];
  for (const c of cells) {
    const [cx, cy, steps, adjusted, failsafe, hit] = c;
    const said = `${steps} steps, ${adjusted} adjusted, ${failsafe} failsafe${hit ? `, ${hit} in collision` : ""}`;
    out.push(tag("rect", { x: x(cx * cell), y: y((cy + 1) * cell), width: per * cell, height: per * cell, fill: heat(value(c) / most) }, tag("title", {}, said)));
    if (hit) out.push(tag("circle", { cx: x((cx + 0.5) * cell), cy: y((cy + 0.5) * cell), r: 4, fill: "none", stroke: "#000", "stroke-width": 1.5 }));
  }
  for (const v of ticks(box.x0, box.x1, 5)) out.push(label(x(v), frame.bottom + 15, figure(v), { "text-anchor": "middle" }));
  for (const v of ticks(box.y0, box.y1, 5)) out.push(label(frame.left - 6, y(v) + 4, figure(v), { "text-anchor": "end" }));
  for (let k = 0; k <= 20; k++) out.push(tag("rect", { x: frame.right + 12, y: frame.bottom - 8 - k * 8, width: 12, height: 8.3, fill: heat(k / 20) }));
  out.push(label(frame.right, frame.bottom + 30, "x [m]", { "text-anchor": "end" }), label(frame.left - 6, frame.top - 2, "y [m]", { "text-anchor": "end" }));
  for (const k of [0, 10, 20]) out.push(label(frame.right + 29, frame.bottom - k * 8, form(most * k / 20)));
  return drawing(frame.right + 76, frame.bottom + 34, `${what}, from above`, out);
}

function places(target, robots) {
  for (const [robot, { cell, cells }] of Object.entries(robots)) {
    if (!cells.length) continue;
    const share = (c) => (c[3] + c[4]) / c[2], steps = (c) => c[2];
    const high = (value, some) => { const found = some.map(value).sort((a, b) => a - b); return found[Math.floor(0.98 * (found.length - 1))] ?? 0; };
    const often = cells.filter((c) => c[2] >= 5);
    const made = element("div", { class: "charts", "data-robot": robot }, element("div"), element("div"));
    made.children[0].innerHTML = map(cells, cell, `interventions: share of the steps in a cell of ${figure(cell)} m`, share, Math.max(0.02, high(share, often)), percents);
    made.children[1].innerHTML = map(cells, cell, "steps in a cell", steps, Math.max(2, high(steps, cells)), (v) => figure(Math.round(v)));
    const rows = () => cells.map(([cx, cy, steps, adjusted, failsafe, collisions]) => ({ x_m: cx * cell, y_m: cy * cell, steps, adjusted, failsafe, collisions }));
    saves(made.children[0], `interventions of ${robot} by place`, rows);
    saves(made.children[1], `steps of ${robot} by place`, rows);
    if (Object.keys(robots).length > 1) target.append(element("h3", {}, robot));
    target.append(made);
  }
  if (!target.children.length) target.append(nothing("The log has no positions."));
}

function timeline(target, { lives, lines, bin_s, steps }) {
  if (!lives.length) return target.append(nothing("The log has no Health message."));
  const names = [...new Set(lives.map((life) => life.process))];
  const begin = Math.min(...lives.map((l) => l.start)), end = Math.max(...lives.map((l) => l.end), begin + 1);
  const frame = { left: 120, right: 1030, top: 90, bottom: 90 + 24 * names.length };
  const x = scale(0, end - begin, frame.left, frame.right), at = (t) => Math.min(frame.right, Math.max(frame.left, x(t - begin)));
  const out = [label(4, 16, "steps/s", { class: "title" })];
  if (steps.length) {
    const most = Math.max(...steps.map((s) => s[1])), y = scale(0, most, 70, 8);
    for (const [from, rate] of steps) out.push(tag("rect", { x: at(from), width: Math.max(0.5, at(from + bin_s) - at(from)), y: y(rate), height: 70 - y(rate), fill: "#9db8d8" }, tag("title", {}, `${figure(rate)} steps/s after ${figure(from - begin)} s`)));
    out.push(label(frame.left - 6, 18, figure(most), { "text-anchor": "end" }), tag("line", { x1: frame.left, x2: frame.right, y1: 70, y2: 70, class: "axis" }));
  }
  names.forEach((name, k) => {
    const y = frame.top + 24 * k;
    out.push(label(4, y + 12, name.length > 20 ? `…${name.slice(-19)}` : name), tag("rect", { x: frame.left, y, width: frame.right - frame.left, height: 16, class: "paper" }));
    for (const life of lives.filter((l) => l.process === name)) {
      const said = `${name}: ${figure(life.start - begin)} to ${figure(life.end - begin)} s, ${life.goodbye ? "ended in order" : end - life.end > 3 ? "then silent" : "alive at the end of the log"}`;
      out.push(tag("rect", { x: at(life.start), y, width: Math.max(2, at(life.end) - at(life.start)), height: 16, fill: "#4f9d78", rx: 2 }, tag("title", {}, said)));
      if (!life.goodbye && end - life.end > 3) out.push(tag("rect", { x: at(life.end) - 1.5, y: y - 2, width: 3, height: 20, fill: KINDS.a.color }, tag("title", {}, said)));
      if (life.restart) out.push(tag("path", { d: `M${at(life.start)} ${y - 2} l6 10 l-6 10 z`, class: "solid" }, tag("title", {}, `${name} was restarted`)));
    }
    for (const line of lines.filter((l) => l.process === name)) out.push(tag("circle", { cx: at(line.t), cy: y + 8, r: 3.2, fill: line.level === "ERROR" ? KINDS.a.color : "#f2c14e", stroke: "#fff" }, tag("title", {}, `${line.level}: ${line.text}`)));
  });
  for (const t of ticks(0, end - begin, 8)) out.push(label(x(t), frame.bottom + 14, `${figure(t, 6)} s`, { "text-anchor": "middle" }));
  const box = element("div");
  box.innerHTML = drawing(1040, frame.bottom + 22, "health of the processes", out);
  saves(box, "health of the processes", () => lives.map((life) => ({ process: life.process, from_s: life.start - begin, to_s: life.end - begin, goodbye: life.goodbye, restart: life.restart })));
  target.append(box, legend([["#4f9d78", "alive"], [KINDS.a.color, "silent from here on; an error"], ["#f2c14e", "a warning"], ["#1b2430", "restarted"]]));
}
