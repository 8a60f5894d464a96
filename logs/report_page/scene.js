// Draws one scene from above as SVG: obstacles, goal, path, tube, perceived surroundings, decision.
// The report and the live page share this file. A scene has
//   obstacles [{kind, at, size, yaw}], half (of the edge of a square arena, or null), goal, goal_radius, start,
//   points [[x, y]], kinds (a letter of KINDS for each point), first (step of the first point; 0 if left out), pose [x, y, heading or null], footprint, discs, and
//   decision {from, boxes, arrows, edge, free, hits, movers, swept, promises}, or nothing.

const ARROWS = ["#c77d00", "#1f5fbf"]; // proposed and executed input
const EDGE = "#c02030"; // edge of the half-space that blocks the proposal
const FREE = "#148c78", HIT = "#5a288c", MOVER = "#aa5a28", PROMISE = "#2860be"; // perceived surroundings
const TUBE = "#7a4fc0", PLAN = "#4b2a8c", GOAL = "#1d7f4e", OBSTACLE = "#c9d1da";

/** Map metres to pixels, y upwards: [x0, y0, x1, y1] fits in a square of `size` pixels. */
function projection([x0, y0, x1, y1], size) {
  const per = size / Math.max(x1 - x0, y1 - y0);
  return { per, width: per * (x1 - x0), height: per * (y1 - y0), x: (v) => per * (v - x0), y: (v) => per * (y1 - v) };
}

const points = (v, list) => list.map(([x, y]) => `${v.x(x).toFixed(1)},${v.y(y).toFixed(1)}`).join(" ");
const disc = (v, [x, y, radius], attributes) => tag("circle", { cx: v.x(x), cy: v.y(y), r: v.per * radius, ...attributes });
const box = (v, [x, y, dx, dy], attributes) => tag("rect", { x: v.x(x - dx), y: v.y(y + dy), width: 2 * v.per * dx, height: 2 * v.per * dy, ...attributes });

function obstacleMark(v, { kind, at: [x, y], size, yaw }) {
  const look = { fill: OBSTACLE, stroke: "#8e9aa8" }, cos = Math.cos(yaw), sin = Math.sin(yaw);
  const polygon = (...corners) => tag("polygon", { points: points(v, corners.map(([a, b]) => [x + a * cos - b * sin, y + a * sin + b * cos])), ...look });
  if (kind === "wall") return polygon([0, -1e3], [0, 1e3], [-1e3, 1e3], [-1e3, -1e3]);
  if (kind !== "box") return disc(v, [x, y, size[0]], look);
  const [a, b] = [size[0] / 2, size[1] / 2];
  return polygon([-a, -b], [a, -b], [a, b], [-a, b]);
}

/** The path up to the point `last`, in one polyline per kind of decision, with a dot at each intervention. */
function pathMarks(v, { points: path, kinds, start, first = 0 }, last, faint = false) {
  const parts = [], look = { fill: "none", "stroke-width": faint ? 1.2 : 2.4, "stroke-linecap": "round", "stroke-linejoin": "round", opacity: faint ? 0.25 : 1 };
  for (let k = 0; k <= last; ) {
    const kind = kinds[k], stretch = [path[k - 1] ?? (first ? null : start) ?? path[k]];
    for (; k <= last && kinds[k] === kind; k++) {
      stretch.push(path[k]);
      if (!faint && "dae".includes(kind)) parts.push(tag("circle", { cx: v.x(path[k][0]), cy: v.y(path[k][1]), r: kind === "a" ? 3.4 : 2.2, fill: KINDS[kind].color }));
    }
    parts.push(tag("polyline", { points: points(v, stretch), stroke: KINDS[kind].color, ...look }));
  }
  return parts;
}

/** The tube: one box for each period of the plan, each with the body around it; the plan connects the centers. */
function tubeMarks(v, { from, boxes }, footprint) {
  const parts = boxes.flatMap(([x, y, dx, dy]) => [
    box(v, [x, y, dx + footprint, dy + footprint], { rx: v.per * footprint, fill: TUBE, opacity: 0.1 }),
    box(v, [x, y, dx, dy], { fill: TUBE, "fill-opacity": 0.25, stroke: TUBE, "stroke-width": 1 }),
  ]);
  return [...parts, tag("polyline", { points: points(v, [from, ...boxes]), fill: "none", stroke: PLAN, "stroke-width": 1.6, "stroke-dasharray": "3 2" })];
}

/** Free space and hits of the scan, moving obstacles with the sets that they can reach, reservations of other robots. */
function perceivedMarks(v, { free = [], hits = [], movers = [], swept = [], promises = [] }) {
  const outline = free.length ? [tag("polygon", { points: points(v, free), fill: FREE, "fill-opacity": 0.07, stroke: FREE, "stroke-width": 1, class: "free" })] : [];
  return [
    ...outline,
    ...hits.map(([x, y]) => tag("circle", { cx: v.x(x), cy: v.y(y), r: 1.3, fill: HIT, class: "hit" })),
    ...swept.flat().map((reach) => disc(v, reach, { fill: MOVER, "fill-opacity": 0.12, class: "swept" })),
    ...movers.map((mover) => disc(v, mover, { fill: MOVER, "fill-opacity": 0.8, class: "mover" })),
    ...promises.map((reserved) => box(v, reserved, { fill: PROMISE, "fill-opacity": 0.12, stroke: PROMISE, "stroke-opacity": 0.5, class: "promise" })),
  ];
}

/** An arrow from the robot's position to where an input would take the robot within some periods. */
function arrowMark(v, [x, y], [dx, dy], look) {
  const from = [v.x(x), v.y(y)], to = [v.x(x + dx), v.y(y + dy)], length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (length < 2) return tag("circle", { cx: from[0], cy: from[1], r: 2.5, fill: look.stroke, class: look.class });
  const [ux, uy] = [(to[0] - from[0]) / length, (to[1] - from[1]) / length], head = Math.min(7, 0.5 * length);
  const spot = ([px, py]) => `${px.toFixed(1)} ${py.toFixed(1)}`;
  const side = (s) => spot([to[0] - head * ux + s * 0.5 * head * uy, to[1] - head * uy - s * 0.5 * head * ux]);
  return tag("path", { d: `M${spot(from)} L${spot(to)} M${side(1)} L${spot(to)} L${side(-1)}`, fill: "none", "stroke-width": 2, "stroke-linecap": "round", ...look });
}

/** The edge of a half-space; short strokes are on the side that the robot must not enter. */
function edgeMarks(v, [x, y, nx, ny], reach) {
  const flat = Math.hypot(nx, ny);
  if (flat < 0.2) return []; // the half-space is above or below
  const [ux, uy] = [nx / flat, ny / flat], at = (a, b) => [v.x(x - a * uy + b * ux), v.y(y + a * ux + b * uy)];
  const line = ([x1, y1], [x2, y2], width) => tag("line", { x1, y1, x2, y2, stroke: EDGE, "stroke-width": width, class: "edge" });
  const strokes = [-4, -3, -2, -1, 0, 1, 2, 3, 4].map((i) => line(at((i / 4.5) * reach, 0), at((i / 4.5 + 0.12) * reach, 0.16 * reach), 1));
  return [line(at(-reach, 0), at(reach, 0), 2), ...strokes];
}

function explanationMarks(v, { from, arrows, edge }, footprint) {
  if (!arrows?.length) return [];
  return [...(edge?.length ? edgeMarks(v, edge, 2.5 * footprint) : []), ...arrows.map((way, i) => arrowMark(v, from, way, { stroke: ARROWS[i], class: ["proposed", "executed"][i] }))];
}

/** The discs of the body at its pose; a single dot for an unknown robot. */
function bodyMarks(v, { pose: [px, py, heading], footprint, discs }) {
  const x = v.x(px), y = v.y(py), r = Math.max(4, v.per * footprint), cos = Math.cos(heading ?? 0), sin = Math.sin(heading ?? 0);
  const parts = (discs.length ? discs : [[0, 0, 0]]).map(([ahead, aside, radius]) => tag("circle", { cx: x + v.per * (ahead * cos - aside * sin), cy: y - v.per * (ahead * sin + aside * cos), r: Math.max(4, v.per * radius), "fill-opacity": 0.12, class: "ink", "stroke-width": 1.3 }));
  if (heading !== null) parts.push(tag("line", { x1: x, y1: y, x2: x + r * cos, y2: y - r * sin, class: "ink", "stroke-width": 1.6 }));
  return parts;
}

/** A scale bar of 1, 2 or 5 times a power of ten metres. */
function scaleBar(v) {
  const quarter = v.width / v.per / 4, power = 10 ** Math.floor(Math.log10(quarter)), length = power * [5, 2, 1].find((m) => m * power <= quarter);
  return [tag("path", { d: `M8 ${v.height - 12} v4 h${v.per * length} v-4`, fill: "none", class: "ink" }), label(10, v.height - 14, `${figure(length)} m`)];
}

/** The scene within `bounds` [x0, y0, x1, y1], as an SVG of at most `size` pixels; the path is bold up to the point `last`. */
function drawScene(scene, bounds, size, title, last = scene.points.length - 1) {
  const v = projection(bounds, size), { goal, start, decision, half } = scene;
  return drawing(v.width, v.height, title, [
    tag("rect", { x: 0, y: 0, width: v.width, height: v.height, class: "paper" }),
    half ? box(v, [0, 0, half, half], { fill: "none", stroke: "#667085" }) : "",
    scene.obstacles.map((o) => obstacleMark(v, o)),
    decision ? perceivedMarks(v, decision) : "",
    goal ? disc(v, [...goal, scene.goal_radius], { fill: GOAL, "fill-opacity": 0.18, stroke: GOAL, "stroke-dasharray": "4 3" }) : "",
    start ? tag("circle", { cx: v.x(start[0]), cy: v.y(start[1]), r: 3.5, fill: "#fff", class: "ink", "stroke-width": 1.4 }) : "",
    pathMarks(v, scene, scene.points.length - 1, true),
    pathMarks(v, scene, last),
    decision ? tubeMarks(v, decision, scene.footprint) : "",
    bodyMarks(v, scene),
    decision ? explanationMarks(v, decision, scene.footprint) : "",
    scaleBar(v),
  ]);
}
