// Learning curves: one curve per run, raw and smoothed values, or bands over the seeds of a group.

const COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5d6b7c"]; // distinguishable with color vision deficiency

const CURVES = [
  { title: "goals reached", unit: "share of episodes", of: "bins", grouped: "goals", value: (b) => b.goals, form: percents, low: 0, high: 1, weight: "episodes" },
  { title: "reward of an episode", unit: "without the intervention penalty", of: "bins", grouped: "reward", value: (b) => b.reward, form: figure, weight: "episodes" },
  { title: "interventions", unit: "share of steps", of: "bins", grouped: "interventions", value: (b) => b.adjusted + b.failsafes + (b.recovering || 0), form: percents, low: 0, weight: "steps" },
  { title: "closest approach", unit: "cm, smallest in a bin", of: "bins", value: (b) => b.closest === null ? null : 100 * b.closest, form: figure, most: 0 },
  { title: "windows outside their sets", unit: "share, without widening", of: "bins", value: (b) => b.beyond, form: percents, low: 0, weight: "steps" },
  { title: "widening of the sets", unit: "largest factor in a bin", of: "bins", value: (b) => b.widening, form: figure },
  { title: "half-width of a tube", unit: "cm, largest axis", of: "bins", value: (b) => b.half_width === null ? null : 100 * b.half_width, form: figure, low: 0 },
  { title: "slowed down", unit: "share of steps", of: "bins", value: (b) => b.slowed, form: percents, low: 0, weight: "steps" },
  { title: "critic loss", unit: "from the learner", of: "learner", value: (b) => b.critic_loss, form: figure },
  { title: "mean Q", unit: "discounted reward", of: "learner", value: (b) => b.mean_q, form: figure },
];

/** Moving average over `reach` rows on each side, weighted by `weight`: bins with few episodes are noisy. */
function smoothed(rows, value, weight, reach) {
  return rows.map((_, k) => {
    let sum = 0, total = 0;
    for (let i = Math.max(0, k - reach); i <= Math.min(rows.length - 1, k + reach); i++) {
      const v = value(rows[i]), w = weight ? rows[i][weight] : 1;
      if (v !== null && w > 0) { sum += v * w; total += w; }
    }
    return total > 0 ? sum / total : null;
  });
}

/** Points of one run's curve: step, raw value, and smoothed value over a share of all bins on each side. */
function pointsOf(run, robot, what, share) {
  const rows = run.training[robot]?.[what.of] ?? [];
  const reach = what.weight || what.of === "learner" ? Math.round(share * rows.length) : 0;
  const soft = smoothed(rows, what.value, what.weight, reach);
  const at = (b) => what.of === "bins" ? b.until - b.steps / 2 : b.steps;
  return rows.map((b, k) => ({ step: at(b), raw: what.value(b), smooth: soft[k] })).filter((p) => p.smooth !== null && Number.isFinite(p.smooth));
}

function between(points, step) {
  const k = points.findIndex((p) => p.step >= step);
  if (k < 0) return null;
  if (k === 0) return points[0].step - step > 0.05 * points.at(-1).step ? null : points[0].smooth;
  const [a, b] = [points[k - 1], points[k]];
  return a.smooth + ((b.smooth - a.smooth) * (step - a.step)) / Math.max(1e-9, b.step - a.step);
}

/** Lines of a chart: one line per run, or one with a band for each group of runs that differ only in their seed. */
function linesOf(runs, groups, robot, what, view) {
  if (view.bands && what.grouped) {
    const shown = (group) => group.robot === robot && group.runs.some((name) => runs.some((run) => run.run === name));
    return groups.filter(shown).map((group) => groupLine(group, what.grouped)).filter(Boolean);
  }
  return runs.map((run) => ({ run, name: run.run, color: run.color, points: pointsOf(run, robot, what, view.share) })).filter((line) => line.points.length > 1);
}

/** Draw one chart. `view`: also the steps that all charts show; `on.click(run, step)`, `on.zoom(from, to)`. */
function chart(lines, what, view, on) {
  const frame = { left: 56, right: 486, top: 30, bottom: 178 };
  const [from, to] = view.range ?? [0, Infinity], inside = (p) => p.step >= from && p.step <= to;
  const end = view.range ? to : Math.max(...lines.flatMap((line) => (line.band ?? line.points).map((p) => p.step)));
  const values = lines.flatMap((line) => line.band ? line.band.filter(inside).flatMap((p) => [p.low ?? p.mean, p.high ?? p.mean]) : line.points.filter(inside).flatMap((p) => view.raw && p.raw !== null ? [p.raw, p.smooth] : [p.smooth]));
  if (!values.length) return null;
  const low = what.low ?? Math.min(what.most ?? Infinity, ...values), high = what.high ?? (Math.max(...values) * (what.low === 0 ? 1.1 : 1) || 1);
  const x = scale(from, end, frame.left, frame.right), y = scale(low, high > low ? high : low + 1, frame.bottom, frame.top);
  const spot = (px, py) => `${px.toFixed(1)},${Math.min(frame.bottom, Math.max(frame.top, py)).toFixed(1)}`;
  const parts = [label(4, 14, [what.title, ` [${what.unit}]`].join(""), { class: "title" })];
  parts.push(axes(frame, x, y, ticks(from, end, 4), ticks(low, high, 4), { y: what.form, x: (v) => v >= 1000 ? `${figure(v / 1000)}k` : figure(v) }));
  for (const line of lines) {
    const drawn = (line.band ?? line.points).filter(inside);
    if (line.band) {
      const wide = drawn.filter((p) => p.low !== null);
      const edge = [...wide.map((p) => spot(x(p.step), y(p.high))), ...wide.toReversed().map((p) => spot(x(p.step), y(p.low)))];
      if (edge.length) parts.push(tag("polygon", { points: edge.join(" "), fill: line.color, opacity: 0.2, class: "band" }));
    } else if (view.raw && (what.weight || what.of === "learner")) {
      const raw = drawn.filter((p) => p.raw !== null).map((p) => tag("circle", { cx: x(p.step), cy: Math.min(frame.bottom, Math.max(frame.top, y(p.raw))), r: 1.5, fill: line.color }));
      parts.push(tag("g", { opacity: 0.35, class: "raw" }, raw));
    }
    const path = (points) => points.map((p) => spot(x(p.step), y(line.band ? p.mean : p.smooth))).join(" ");
    const style = { fill: "none", stroke: line.color, "stroke-width": 1.8, "stroke-linejoin": "round" };
    const some = line.band ? drawn.filter((p) => p.runs < line.all) : []; // where some runs of the group have ended
    parts.push(tag("polyline", { points: path(line.band ? drawn.filter((p) => p.runs === line.all) : drawn), ...style, "data-run": line.name }));
    if (some.length) parts.push(tag("polyline", { points: path(some), ...style, "stroke-width": 1, "stroke-dasharray": "4 3", class: "some" }));
  }
  parts.push(tag("rect", { y: frame.top, height: frame.bottom - frame.top, width: 0, class: "zooming" }), tag("line", { y1: frame.top, y2: frame.bottom, class: "cross" }));
  parts.push(label(frame.right, 208, "steps of all actors of the run", { "text-anchor": "end" }));
  const box = element("figure", { class: "chart", "data-chart": what.title });
  box.innerHTML = drawing(496, 214, what.title, parts);
  const stepAt = (px) => from + (Math.min(1, Math.max(0, (px - frame.left) / (frame.right - frame.left)))) * (end - from);
  hovers(box, (px) => {
    if (px < frame.left) return null;
    const step = stepAt(px);
    const said = lines.map((line) => {
      const drawn = line.band ?? line.points, p = drawn.find((p) => p.step >= step);
      return p && `${lines.length > 1 ? `${line.name}: ` : ""}${what.form(line.band ? p.mean : p.smooth)}${line.band && p.low !== null ? ` (${what.form(p.low)} to ${what.form(p.high)})` : ""}${line.band && p.runs < line.all ? `, ${p.runs} of ${line.all} runs` : ""}`;
    }).filter(Boolean);
    return said.length ? `step ${figure(step, 6)}\n${said.join("\n")}` : null;
  });
  box.cross = (step) => place(box.querySelector(".cross"), step, x, from, end);
  followPointer(box, stepAt, x, { ...on, nearest: (step, py) => nearestLine(lines, step, (p) => Math.abs(y(p) - py)) });
  saves(box, what.title, () => lines.flatMap((line) => line.band ? line.band.map((p) => ({ group: line.name, ...p })) : line.points.map((p) => ({ run: line.name, ...p }))));
  return box;
}

/** Show a chart's vertical line at a step; hide it if the chart does not show the step. */
function place(line, step, x, from, end) {
  const seen = step !== null && step >= from && step <= end;
  line.style.display = seen ? "inline" : "none";
  if (seen) for (const name of ["x1", "x2"]) line.setAttribute(name, x(step));
}

/** The run whose line is nearest at a step; `away(value)` is the distance of a value. A band is no single run. */
function nearestLine(lines, step, away) {
  const single = lines.filter((line) => line.run && line.points.length).map((line) => [line.run, between(line.points, step)]).filter(([, value]) => value !== null);
  return single.length ? single.reduce((a, b) => (away(b[1]) < away(a[1]) ? b : a))[0] : null;
}

/** Follow the pointer on a chart: move the line on all charts; a drag zooms, a click opens an episode. */
function followPointer(box, stepAt, x, on) {
  const svg = box.querySelector("svg"), zooming = box.querySelector(".zooming");
  let pressed = null;
  svg.addEventListener("pointerdown", (event) => { if (event.button === 0) [pressed] = pointIn(svg, event); });
  svg.addEventListener("pointermove", (event) => {
    const [px] = pointIn(svg, event), step = stepAt(px);
    on.cross(step);
    if (pressed === null) return;
    zooming.setAttribute("x", Math.min(x(stepAt(pressed)), x(step)));
    zooming.setAttribute("width", Math.abs(x(step) - x(stepAt(pressed))));
  });
  svg.addEventListener("pointerup", (event) => {
    const [px, py] = pointIn(svg, event), begun = pressed;
    pressed = null;
    zooming.setAttribute("width", 0);
    if (begun === null) return;
    if (Math.abs(px - begun) > 8) return on.zoom(...[stepAt(begun), stepAt(px)].sort((a, b) => a - b));
    const run = on.nearest(stepAt(px), py);
    if (run) on.click(run, stepAt(px));
  });
  svg.addEventListener("pointerleave", () => { pressed = null; zooming.setAttribute("width", 0); on.cross(null); });
}

/** Draw the curves with their controls. `runs` is the page's data; a click on a curve calls `open(run, robot, step)`. */
function learning(target, controls, runs, groups, open) {
  const robots = [...new Set(runs.flatMap((run) => Object.keys(run.training)))].sort();
  const seeds = groups.some((group) => group.runs.length > 1);
  const own = (run) => groups.find((group) => group.runs.includes(run.run))?.color;
  runs.forEach((run, k) => { run.color = own(run) ?? COLORS[k % COLORS.length]; });
  const view = { share: 0.02, raw: true, bands: seeds, shown: new Set(runs), range: null };
  const cross = (step) => target.querySelectorAll("figure.chart").forEach((box) => box.cross(step));
  const zoom = (from, to) => { view.range = from === null ? null : [from, to]; draw(); };
  const whole = element("button", { id: "whole", hidden: "", onclick: () => zoom(null) }, "show all steps");
  const draw = () => {
    target.replaceChildren();
    whole.hidden = view.range === null;
    const shown = runs.filter((run) => view.shown.has(run));
    for (const robot of robots) {
      const drawn = CURVES.map((what) => [what, linesOf(shown, groups, robot, what, view)]).map(([what, lines]) => lines.length ? chart(lines, what, view, { cross, zoom, click: (run, step) => open(run, robot, step) }) : null).filter(Boolean);
      if (!drawn.length) continue;
      if (robots.length > 1) target.append(element("h3", {}, robot));
      const grid = element("div", { class: "charts", "data-robot": robot });
      grid.append(...drawn);
      target.append(grid);
    }
    if (!target.children.length) target.append(nothing("The log has no steps."));
  };
  if (runs.length > 1) controls.append(picker(runs, view, draw));
  const smooth = element("select", { id: "smoothing", "aria-label": "smoothing", onchange: () => { view.share = +smooth.value; draw(); } });
  for (const [share, words] of [[0, "not smoothed"], [0.02, "smoothed over 4 % of the run"], [0.05, "smoothed over 10 % of the run"]]) smooth.append(element("option", { value: share, ...(share === view.share ? { selected: "" } : {}) }, words));
  const raw = element("input", { type: "checkbox", id: "raw", checked: "", onchange: () => { view.raw = raw.checked; draw(); } });
  controls.append(smooth, element("label", {}, raw, " raw values as dots"), whole);
  target.before(element("p", { class: "small hint" }, "A click on a curve opens the episode of that step. Drag along the steps to zoom; a double click shows all steps again."));
  target.addEventListener("dblclick", () => zoom(null));
  if (seeds) {
    const bands = element("input", { type: "checkbox", id: "bands", checked: "", onchange: () => { view.bands = bands.checked; draw(); } });
    controls.append(element("label", {}, bands, " seeds as mean and 95 % interval"));
  }
  draw();
}

/** Checkboxes that select the drawn runs. */
function picker(runs, view, draw) {
  const box = element("span", { class: "runs", role: "group", "aria-label": "runs that are drawn" });
  for (const run of runs) {
    const tick = element("input", { type: "checkbox", checked: "", "data-run": run.run, onchange: () => { if (tick.checked) view.shown.add(run); else view.shown.delete(run); draw(); } });
    box.append(element("label", {}, tick, element("i", { style: `background:${run.color}` }), run.run));
  }
  return box;
}
