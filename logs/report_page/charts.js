// Rates, latencies, the map of interventions, the timeline of processes.

function whiskers(root) {
  for (const cell of root.querySelectorAll("td.whisker")) {
    const { rate, low, high } = cell.dataset;
    if (rate === "") continue;
    const most = Math.max(+high || 0, +rate) > 0.2 ? 1 : Math.max(+high || 0, +rate, 1e-9) * 1.15;
    const x = scale(0, most, 4, 256);
    const parts = [tag("line", { x1: 4, x2: 256, y1: 10, y2: 10, stroke: color("line"), "stroke-width": 2 })];
    if (low !== "") parts.push(tag("line", { x1: x(+low), x2: x(+high), y1: 10, y2: 10, stroke: color("allowed"), "stroke-width": 5, "stroke-linecap": "round", opacity: 0.35 }));
    parts.push(tag("circle", { cx: x(+rate), cy: 10, r: 4, fill: color("allowed") }));
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

/** A map of interventions in the robot's frame, which looks to the right. */
function interventionMap({ cell, cells, heading, footprint }) {
  const count = (c) => c[2] + c[3] + c[4], counts = cells.map(count).sort((a, b) => a - b), most = Math.max(2, counts[Math.floor(0.98 * (counts.length - 1))]);
  const reach = cell * (1 + Math.max(3, ...cells.flatMap(([x, y]) => [Math.abs(x), Math.abs(x + 1), Math.abs(y), Math.abs(y + 1)])));
  const frame = { left: 44, top: 26, right: 444, bottom: 426 }, x = scale(-reach, reach, frame.left, frame.right), y = scale(-reach, reach, frame.bottom, frame.top), per = x(1) - x(0);
  const out = [label(4, 14, `interventions in a cell of ${figure(cell)} m`, { class: "title" }), tag("rect", { x: frame.left, y: frame.top, width: 400, height: 400, class: "paper" })];
  for (const c of cells) {
    const said = `${c[2]} adjusted, ${c[3]} failsafe, ${c[4]} recovering: ${figure((c[0] + 0.5) * cell)} m ahead, ${figure((c[1] + 0.5) * cell)} m to the left`;
    out.push(tag("rect", { x: x(c[0] * cell), y: y((c[1] + 1) * cell), width: per * cell, height: per * cell, fill: heat(count(c) / most) }, tag("title", {}, said)));
  }
  out.push(tag("circle", { cx: x(0), cy: y(0), r: Math.max(4, per * footprint), fill: "none", class: "ink", "stroke-width": 1.5 }), tag("line", { x1: x(0), y1: y(0), x2: x(0) + Math.max(10, 1.8 * per * footprint), y2: y(0), class: "ink", "stroke-width": 2 }));
  for (const v of ticks(-reach, reach, 6)) out.push(label(x(v), frame.bottom + 15, figure(v), { "text-anchor": "middle" }), label(frame.left - 6, y(v) + 4, figure(v), { "text-anchor": "end" }));
  for (let k = 0; k <= 20; k++) out.push(tag("rect", { x: frame.right + 12, y: frame.bottom - 8 - k * 8, width: 12, height: 8.3, fill: heat(k / 20) }));
  for (const k of [0, 10, 20]) out.push(label(frame.right + 29, frame.bottom - k * 8, figure(Math.round((most * k) / 20))));
  out.push(label(frame.right, frame.bottom + 30, `ahead [m], ${heading ? "as the robot looks" : "in the direction of the proposed motion"}`, { "text-anchor": "end" }), label(4, frame.bottom + 30, "upwards: left [m]"));
  return drawing(frame.right + 76, frame.bottom + 34, "interventions around the robot, from above", out);
}

function places(target, robots) {
  for (const [robot, about] of Object.entries(robots)) {
    if (!about.cells.length && !about.elsewhere) continue;
    const drawn = element("div", { class: "charts", "data-robot": robot }), map = element("div");
    if (about.cells.length) {
      map.innerHTML = interventionMap(about);
      saves(map, `interventions around ${robot}`, () => about.cells.map(([cx, cy, adjusted, failsafe, recovering]) => ({ ahead_m: cx * about.cell, left_m: cy * about.cell, adjusted, failsafe, recovering })));
      drawn.append(map);
    }
    if (Object.keys(robots).length > 1) target.append(element("h3", {}, robot));
    target.append(drawn);
    if (about.elsewhere) target.append(element("p", { class: "small" }, `${about.elsewhere} interventions have no place, for instance because a limit of the speed was the reason.`));
  }
  if (!target.children.length) target.append(nothing("The log has no intervention."));
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
    for (const [from, rate] of steps) out.push(tag("rect", { x: at(from), width: Math.max(0.5, at(from + bin_s) - at(from)), y: y(rate), height: 70 - y(rate), fill: color("bar") }, tag("title", {}, `${figure(rate)} steps/s after ${figure(from - begin)} s`)));
    out.push(label(frame.left - 6, 18, figure(most), { "text-anchor": "end" }), tag("line", { x1: frame.left, x2: frame.right, y1: 70, y2: 70, class: "axis" }));
  }
  names.forEach((name, k) => {
    const y = frame.top + 24 * k;
    out.push(label(4, y + 12, name.length > 20 ? `…${name.slice(-19)}` : name), tag("rect", { x: frame.left, y, width: frame.right - frame.left, height: 16, class: "paper" }));
    for (const life of lives.filter((l) => l.process === name)) {
      const said = `${name}: ${figure(life.start - begin)} to ${figure(life.end - begin)} s, ${life.goodbye ? "ended in order" : end - life.end > 3 ? "then silent" : "alive at the end of the log"}`;
      out.push(tag("rect", { x: at(life.start), y, width: Math.max(2, at(life.end) - at(life.start)), height: 16, fill: color("alive"), rx: 2 }, tag("title", {}, said)));
      if (!life.goodbye && end - life.end > 3) out.push(tag("rect", { x: at(life.end) - 1.5, y: y - 2, width: 3, height: 20, fill: KINDS.a.color }, tag("title", {}, said)));
      if (life.restart) out.push(tag("path", { d: `M${at(life.start)} ${y - 2} l6 10 l-6 10 z`, class: "solid" }, tag("title", {}, `${name} was restarted`)));
    }
    for (const line of lines.filter((l) => l.process === name)) out.push(tag("circle", { cx: at(line.t), cy: y + 8, r: 3.2, fill: line.level === "ERROR" ? KINDS.a.color : color("warning"), stroke: color("paper") }, tag("title", {}, `${line.level}: ${line.text}`)));
  });
  for (const t of ticks(0, end - begin, 8)) out.push(label(x(t), frame.bottom + 14, `${figure(t, 6)} s`, { "text-anchor": "middle" }));
  const box = element("div");
  box.innerHTML = drawing(1040, frame.bottom + 22, "health of the processes", out);
  saves(box, "health of the processes", () => lives.map((life) => ({ process: life.process, from_s: life.start - begin, to_s: life.end - begin, goodbye: life.goodbye, restart: life.restart })));
  target.append(box, legend([[color("alive"), "alive"], [KINDS.a.color, "silent from here on; an error"], [color("warning"), "a warning"], [color("ink"), "restarted"]]));
}
