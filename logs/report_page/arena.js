// One episode from above: obstacles, goal, path by decision, a tube and the plan in it.

/** The part of the plane that an episode needs. */
function bounds(episode) {
  const xs = [...episode.x], ys = [...episode.y];
  const add = (x, y, reach = 0) => { xs.push(x - reach, x + reach); ys.push(y - reach, y + reach); };
  if (episode.goal) add(...episode.goal, episode.goal_radius);
  if (episode.start) add(...episode.start);
  for (const o of episode.obstacles) add(o.at[0], o.at[1], o.kind === "wall" ? 0 : 0.5 * Math.hypot(...o.size.slice(0, 2)));
  const pad = 0.04 * Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 0.5);
  return [Math.min(...xs) - pad, Math.min(...ys) - pad, Math.max(...xs) + pad, Math.max(...ys) + pad];
}

/** A square or less of `size` pixels that shows [x0, y0, x1, y1] with y upwards. */
function view([x0, y0, x1, y1], size) {
  const per = size / Math.max(x1 - x0, y1 - y0);
  return { per, width: per * (x1 - x0), height: per * (y1 - y0), x: (v) => per * (v - x0), y: (v) => per * (y1 - v) };
}

function polygon(v, points, attributes) {
  return tag("polygon", { points: points.map(([x, y]) => `${v.x(x).toFixed(2)},${v.y(y).toFixed(2)}`).join(" "), ...attributes });
}

function obstacle(v, o) {
  const fill = { fill: "#c9d1da", stroke: "#8e9aa8" };
  const [x, y] = o.at, cos = Math.cos(o.yaw), sin = Math.sin(o.yaw);
  const corner = (a, b) => [x + a * cos - b * sin, y + a * sin + b * cos];
  if (o.kind === "wall") return polygon(v, [corner(0, -1e3), corner(0, 1e3), corner(-1e3, 1e3), corner(-1e3, -1e3)], fill);
  if (o.kind === "box") {
    const [a, b] = [o.size[0] / 2, o.size[1] / 2];
    return polygon(v, [corner(-a, -b), corner(a, -b), corner(a, b), corner(-a, b)], fill);
  }
  return tag("circle", { cx: v.x(x), cy: v.y(y), r: v.per * o.size[0], ...fill });
}

/** The path up to `last`, in stretches of one kind of decision; interventions as dots too. */
function path(v, episode, last, faint) {
  const parts = [], { x, y, kinds } = episode;
  const from = episode.first === 0 && episode.start ? episode.start : [x[0], y[0]];
  let previous = from;
  let run = null;
  const flush = () => { if (run) parts.push(tag("polyline", { points: run.points.join(" "), fill: "none", stroke: KINDS[run.kind].color, "stroke-width": faint ? 1.2 : 2.4, "stroke-linecap": "round", "stroke-linejoin": "round", opacity: faint ? 0.25 : 1 })); };
  const point = ([px, py]) => `${v.x(px).toFixed(1)},${v.y(py).toFixed(1)}`;
  for (let k = 0; k <= last; k++) {
    const here = [x[k], y[k]];
    if (run?.kind !== kinds[k]) { flush(); run = { kind: kinds[k], points: [point(previous)] }; }
    run.points.push(point(here));
    if (!faint && "dae".includes(kinds[k])) parts.push(tag("circle", { cx: v.x(here[0]), cy: v.y(here[1]), r: kinds[k] === "a" ? 3.4 : 2.2, fill: KINDS[kinds[k]].color }));
    previous = here;
  }
  flush();
  return parts;
}

/** The tube of a step: a box for each step of its plan, which runs through their centres. */
function tube(v, t, footprint) {
  const parts = [];
  for (const [cx, cy, wx, wy] of t.boxes) {
    parts.push(tag("rect", { x: v.x(cx - wx - footprint), y: v.y(cy + wy + footprint), width: 2 * v.per * (wx + footprint), height: 2 * v.per * (wy + footprint), rx: v.per * footprint, fill: "#7a4fc0", opacity: 0.1 }));
    parts.push(tag("rect", { x: v.x(cx - wx), y: v.y(cy + wy), width: 2 * v.per * wx, height: 2 * v.per * wy, fill: "#7a4fc0", "fill-opacity": 0.25, stroke: "#7a4fc0", "stroke-width": 1 }));
  }
  const points = [t.from, ...t.boxes].map(([x, y]) => `${v.x(x).toFixed(1)},${v.y(y).toFixed(1)}`).join(" ");
  parts.push(tag("polyline", { points, fill: "none", stroke: "#4b2a8c", "stroke-width": 1.6, "stroke-dasharray": "3 2" }));
  return parts;
}

const FREE = "#148c78", HIT = "#5a288c", MOVER = "#aa5a28", PROMISE = "#2860be"; // what the filter was told

/** What a scan hit and showed to be free, what moves and may come to where, where other robots promise to be. */
function told(v, { free = [], hits = [], movers = [], swept = [], promises = [] }) {
  const parts = free.length ? [polygon(v, free, { fill: FREE, "fill-opacity": 0.07, stroke: FREE, "stroke-width": 1, class: "free" })] : [];
  parts.push(...hits.map(([x, y]) => tag("circle", { cx: v.x(x), cy: v.y(y), r: 1.3, fill: HIT, class: "hit" })));
  parts.push(...swept.flat().map(([x, y, radius]) => tag("circle", { cx: v.x(x), cy: v.y(y), r: v.per * radius, fill: MOVER, "fill-opacity": 0.12, class: "swept" })));
  parts.push(...movers.map(([x, y, radius]) => tag("circle", { cx: v.x(x), cy: v.y(y), r: v.per * radius, fill: MOVER, "fill-opacity": 0.8, class: "mover" })));
  parts.push(...promises.map(([x, y, dx, dy]) => tag("rect", { x: v.x(x - dx), y: v.y(y + dy), width: 2 * v.per * dx, height: 2 * v.per * dy, fill: PROMISE, "fill-opacity": 0.12, stroke: PROMISE, "stroke-opacity": 0.5, class: "promise" })));
  return parts;
}

const ARROWS = ["#c77d00", "#1f5fbf"]; // proposed, executed
const EDGE = "#c02030";

/** From where it was asked to where an input would take the robot in some periods. */
function arrow(v, [x, y], [dx, dy], attributes) {
  const from = [v.x(x), v.y(y)], to = [v.x(x + dx), v.y(y + dy)], length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (length < 2) return tag("circle", { cx: from[0], cy: from[1], r: 2.5, fill: attributes.stroke });
  const [ux, uy] = [(to[0] - from[0]) / length, (to[1] - from[1]) / length], head = Math.min(7, 0.5 * length);
  const side = (s) => `${(to[0] - head * ux + s * 0.5 * head * uy).toFixed(1)} ${(to[1] - head * uy - s * 0.5 * head * ux).toFixed(1)}`;
  return tag("path", { d: `M${from[0].toFixed(1)} ${from[1].toFixed(1)} L${to[0].toFixed(1)} ${to[1].toFixed(1)} M${side(1)} L${to[0].toFixed(1)} ${to[1].toFixed(1)} L${side(-1)}`, fill: "none", "stroke-width": 2, "stroke-linecap": "round", ...attributes });
}

/** The edge of a half-space, with strokes on the side where the robot may not be. */
function edge(v, [x, y, nx, ny], reach) {
  const flat = Math.hypot(nx, ny);
  if (flat < 0.2) return []; // it is above or below
  const [ux, uy] = [nx / flat, ny / flat], parts = [], at = (a, b) => [v.x(x - a * uy + b * ux), v.y(y + a * ux + b * uy)];
  const line = ([x1, y1], [x2, y2], width) => parts.push(tag("line", { x1, y1, x2, y2, stroke: EDGE, "stroke-width": width, class: "edge" }));
  line(at(-reach, 0), at(reach, 0), 2);
  for (let i = -4; i <= 4; i++) line(at((i / 4.5) * reach, 0), at((i / 4.5 + 0.12) * reach, 0.16 * reach), 1);
  return parts;
}

/** What was asked for and what was done, and what stood in the way. */
function explained(v, t, footprint) {
  if (!t.arrows) return [];
  const parts = t.edge ? edge(v, t.edge, 2.5 * footprint) : [];
  return [...parts, arrow(v, t.from, t.arrows[0], { stroke: ARROWS[0], class: "proposed" }), arrow(v, t.from, t.arrows[1], { stroke: ARROWS[1], class: "executed" })];
}

function robot(v, episode, k) {
  const x = v.x(episode.x[k]), y = v.y(episode.y[k]), r = Math.max(4, v.per * episode.footprint);
  const heading = episode.heading?.[k] ?? 0, cos = Math.cos(heading), sin = Math.sin(heading);
  const discs = episode.discs.length ? episode.discs : [[0, 0, 0]]; // of an unknown robot: a dot
  const parts = discs.map(([ahead, aside, radius]) => tag("circle", { cx: x + v.per * (ahead * cos - aside * sin), cy: y - v.per * (ahead * sin + aside * cos), r: Math.max(4, v.per * radius), "fill-opacity": 0.12, class: "ink", "stroke-width": 1.3 }));
  if (episode.heading) parts.push(tag("line", { x1: x, y1: y, x2: x + r * cos, y2: y - r * sin, class: "ink", "stroke-width": 1.6 }));
  return parts;
}

/** The episode at step `k`, within `box` or all of it. */
function arena(episode, k, size, box = null) {
  const v = view(box || bounds(episode), size);
  const parts = [tag("rect", { x: 0, y: 0, width: v.width, height: v.height, class: "paper" })];
  parts.push(...episode.obstacles.map((o) => obstacle(v, o)));
  if (episode.tubes[k]) parts.push(told(v, episode.tubes[k]));
  if (episode.goal) parts.push(tag("circle", { cx: v.x(episode.goal[0]), cy: v.y(episode.goal[1]), r: v.per * episode.goal_radius, fill: "#1d7f4e", "fill-opacity": 0.18, stroke: "#1d7f4e", "stroke-dasharray": "4 3" }));
  if (episode.start) parts.push(tag("circle", { cx: v.x(episode.start[0]), cy: v.y(episode.start[1]), r: 3.5, fill: "#fff", class: "ink", "stroke-width": 1.4 }));
  parts.push(path(v, episode, episode.steps - 1, true), path(v, episode, Math.min(k, episode.x.length - 1), false));
  if (episode.tubes[k]) parts.push(tube(v, episode.tubes[k], episode.footprint));
  parts.push(robot(v, episode, k));
  if (episode.tubes[k]) parts.push(explained(v, episode.tubes[k], episode.footprint));
  const quarter = v.width / v.per / 4, power = 10 ** Math.floor(Math.log10(quarter));
  const length = power * [5, 2, 1].find((m) => m * power <= quarter);
  parts.push(tag("path", { d: `M8 ${v.height - 12} v4 h${v.per * length} v-4`, fill: "none", class: "ink" }), label(10, v.height - 14, `${figure(length)} m`));
  return drawing(v.width, v.height, `${episode.actor}, episode ${episode.episode}, step ${episode.first + k}`, parts);
}
