// Draws one scene from above or from the side as SVG: obstacles, goal, path, tube, perceived surroundings, decision.
// A scene has
//   obstacles [{kind, at, size, yaw}], half (of the edge of a square arena, or null), floor, ceiling (heights or null), goal, goal_radius, start,
//   points [[x, y] or [x, y, z]], kinds (a letter of KINDS for each point), first (step of the first point; 0 if left out), pose [x, y, heading or null, z or nothing], footprint, discs, and
//   decision {from, boxes, arrows, edge, free, hits, movers, swept, reservations}, or nothing.

const ABOVE = [0, 1], ASIDE = [0, 2]; // the axes of a drawing from above, and of one from the side (towards the north)

/** Map metres to pixels, the second axis upwards: [x0, y0, x1, y1] fits in a square of `size` pixels. */
function projection([x0, y0, x1, y1], size, axes = ABOVE) {
  const per = size / Math.max(x1 - x0, y1 - y0), [a, b] = axes;
  return { per, axes, side: axes === ASIDE, width: per * (x1 - x0), height: per * (y1 - y0), x: (v) => per * (v - x0), y: (v) => per * (y1 - v), pick: (row) => [row[a], row[b] ?? 0] };
}

const points = (v, list) => list.map(v.pick).map(([x, y]) => `${v.x(x).toFixed(1)},${v.y(y).toFixed(1)}`).join(" ");
const dot = (v, row, r, attributes) => { const [x, y] = v.pick(row); return tag("circle", { cx: v.x(x), cy: v.y(y), r, ...attributes }); };
const disc = (v, row, attributes) => dot(v, row, v.per * row.at(-1), attributes);
const rectangle = (v, x, y, dx, dy, attributes) => tag("rect", { x: v.x(x - dx), y: v.y(y + dy), width: 2 * v.per * dx, height: 2 * v.per * dy, ...attributes });

/** A box: its center, then its half-widths. */
function box(v, row, attributes, more = 0) {
  const d = row.length / 2;
  return rectangle(v, ...v.pick(row), ...v.pick(row.slice(d)).map((half) => half + more), attributes);
}

function obstacleMark(v, { kind, at, size, yaw = 0 }) {
  const look = { fill: color("obstacle"), stroke: color("obstacle-edge") }, cos = Math.cos(yaw), sin = Math.sin(yaw), [x, y] = at;
  if (v.side) {
    if (kind === "wall") return "";
    if (kind === "sphere") return disc(v, [...at, size[0]], look);
    const reach = kind === "box" ? [Math.abs(cos) * size[0] + Math.abs(sin) * size[1], size[2]].map((edge) => edge / 2) : [size[0], size[1] / 2];
    return rectangle(v, x, at[2], ...reach, { ...look, "fill-opacity": 0.6 });
  }
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
      if (!faint && INTERVENTIONS.includes(kind)) parts.push(dot(v, path[k], kind === "a" ? 3.4 : 2.2, { fill: KINDS[kind].color }));
    }
    parts.push(tag("polyline", { points: points(v, stretch), stroke: KINDS[kind].color, ...look }));
  }
  return parts;
}

/** The tube: one box for each period of the plan, each with the body around it; the plan connects the centers. */
function tubeMarks(v, { from, boxes }, footprint) {
  const parts = boxes.flatMap((row) => [
    box(v, row, { rx: v.per * footprint, fill: color("tube"), opacity: 0.1 }, footprint),
    box(v, row, { fill: color("tube"), "fill-opacity": 0.25, stroke: color("tube"), "stroke-width": 1, class: "tube" }),
  ]);
  return [...parts, tag("polyline", { points: points(v, [from, ...boxes]), fill: "none", stroke: color("plan"), "stroke-width": 1.6, "stroke-dasharray": "3 2" })];
}

/** Free space and hits of the scan, moving obstacles with the sets that they can reach, reservations of other robots. */
function perceivedMarks(v, { free = [], hits = [], movers = [], swept = [], reservations = [] }) {
  const outline = free.length && !v.side ? [tag("polygon", { points: points(v, free), fill: color("free"), "fill-opacity": 0.07, stroke: color("free"), "stroke-width": 1, class: "free" })] : [];
  return [
    ...outline,
    ...hits.map((hit) => dot(v, hit, 1.3, { fill: color("hit"), class: "hit" })),
    ...swept.flat().map((reach) => disc(v, reach, { fill: color("mover"), "fill-opacity": 0.12, class: "swept" })),
    ...movers.map((mover) => disc(v, mover, { fill: color("mover"), "fill-opacity": 0.8, class: "mover" })),
    ...reservations.map((reserved) => box(v, reserved, { fill: color("reserved"), "fill-opacity": 0.12, stroke: color("reserved"), "stroke-opacity": 0.5, class: "reservation" })),
  ];
}

/** An arrow from the robot's position to where an input would take the robot within some periods. */
function arrowMark(v, position, way, look) {
  const [x, y] = v.pick(position), [dx, dy] = v.pick(way);
  const from = [v.x(x), v.y(y)], to = [v.x(x + dx), v.y(y + dy)], length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (length < 2) return tag("circle", { cx: from[0], cy: from[1], r: 2.5, fill: look.stroke, class: look.class });
  const [ux, uy] = [(to[0] - from[0]) / length, (to[1] - from[1]) / length], head = Math.min(7, 0.5 * length);
  const spot = ([px, py]) => `${px.toFixed(1)} ${py.toFixed(1)}`;
  const side = (s) => spot([to[0] - head * ux + s * 0.5 * head * uy, to[1] - head * uy - s * 0.5 * head * ux]);
  return tag("path", { d: `M${spot(from)} L${spot(to)} M${side(1)} L${spot(to)} L${side(-1)}`, fill: "none", "stroke-width": 2, "stroke-linecap": "round", ...look });
}

/** The edge of a half-space; short strokes are on the side that the robot must not enter. */
function edgeMarks(v, edge, reach) {
  const d = edge.length / 2, [x, y] = v.pick(edge), [nx, ny] = v.pick(edge.slice(d));
  const flat = Math.hypot(nx, ny);
  if (flat < 0.2) return []; // the half-space's edge lies in the plane of the drawing
  const [ux, uy] = [nx / flat, ny / flat], at = (a, b) => [v.x(x - a * uy + b * ux), v.y(y + a * ux + b * uy)];
  const line = ([x1, y1], [x2, y2], width) => tag("line", { x1, y1, x2, y2, stroke: color("halfspace"), "stroke-width": width, class: "edge" });
  const strokes = [-4, -3, -2, -1, 0, 1, 2, 3, 4].map((i) => line(at((i / 4.5) * reach, 0), at((i / 4.5 + 0.12) * reach, 0.16 * reach), 1));
  return [line(at(-reach, 0), at(reach, 0), 2), ...strokes];
}

function explanationMarks(v, { from, arrows, edge }, footprint) {
  if (!arrows?.length) return [];
  return [...(edge?.length ? edgeMarks(v, edge, 2.5 * footprint) : []), ...arrows.map((way, i) => arrowMark(v, from, way, { stroke: color(["proposed", "executed"][i]), class: ["proposed", "executed"][i] }))];
}

/** The discs of the body at its pose; a single dot for an unknown robot. */
function bodyMarks(v, { pose: [px, py, heading, pz], footprint, discs }) {
  const cos = Math.cos(heading ?? 0), sin = Math.sin(heading ?? 0), height = pz ?? 0;
  const parts = (discs.length ? discs : [[0, 0, 0]]).map((row) => {
    const [ahead, aside] = row, above = row.length > 3 ? row[2] : 0;
    return dot(v, [px + ahead * cos - aside * sin, py + ahead * sin + aside * cos, height + above], Math.max(4, v.per * row.at(-1)), { "fill-opacity": 0.12, class: "ink", "stroke-width": 1.3 });
  });
  const x = v.x(px), y = v.y(py), r = Math.max(4, v.per * footprint);
  if (heading !== null && !v.side) parts.push(tag("line", { x1: x, y1: y, x2: x + r * cos, y2: y - r * sin, class: "ink", "stroke-width": 1.6 }));
  return parts;
}

/** A scale bar of 1, 2 or 5 times a power of ten metres. */
function scaleBar(v) {
  const quarter = v.width / v.per / 4, power = 10 ** Math.floor(Math.log10(quarter)), length = power * [5, 2, 1].find((m) => m * power <= quarter);
  return [tag("path", { d: `M8 ${v.height - 12} v4 h${v.per * length} v-4`, fill: "none", class: "ink" }), label(10, v.height - 14, `${figure(length)} m`)];
}

/** The edges of the arena: a square from above; from the side, the floor, the ceiling and two walls. */
function roomMarks(v, { half, floor, ceiling }) {
  if (!half) return "";
  if (!v.side) return rectangle(v, 0, 0, half, half, { fill: "none", stroke: color("wall") });
  const low = floor ?? 0, high = ceiling ?? low + half;
  return rectangle(v, 0, (low + high) / 2, half, (high - low) / 2, { fill: "none", stroke: color("wall") });
}

/** The scene within `bounds` [x0, y0, x1, y1], as an SVG of at most `size` pixels; the path is bold up to the point `last`. */
function drawScene(scene, bounds, size, title, last = scene.points.length - 1, axes = ABOVE) {
  const v = projection(bounds, size, axes), { goal, start, decision } = scene;
  const around = { movers: scene.movers ?? [], ...decision };
  return drawing(v.width, v.height, title, [
    tag("rect", { x: 0, y: 0, width: v.width, height: v.height, class: "paper" }),
    roomMarks(v, scene),
    scene.obstacles.map((o) => obstacleMark(v, o)),
    perceivedMarks(v, around),
    goal ? disc(v, [...goal, scene.goal_radius], { fill: color("goal"), "fill-opacity": 0.18, stroke: color("goal"), "stroke-dasharray": "4 3" }) : "",
    start ? dot(v, start, 3.5, { fill: color("paper"), class: "ink", "stroke-width": 1.4 }) : "",
    pathMarks(v, scene, scene.points.length - 1, true),
    pathMarks(v, scene, last),
    decision ? tubeMarks(v, decision, scene.footprint) : "",
    bodyMarks(v, scene),
    decision ? explanationMarks(v, decision, scene.footprint) : "",
    scaleBar(v),
  ]);
}

/** The smallest rectangle that holds a scene: its arena or its path, start, goal and obstacles. */
function sceneBounds(scene, axes = ABOVE) {
  const { half, floor, ceiling } = scene, side = axes === ASIDE, values = [[], []];
  const add = (row, reach = 0) => axes.forEach((axis, i) => values[i].push((row[axis] ?? 0) - reach, (row[axis] ?? 0) + reach));
  if (half && side) add([-half, 0, floor ?? 0]), add([half, 0, ceiling ?? half]);
  else if (half) add([0, 0], half);
  scene.points.forEach((point) => add(point));
  if (scene.goal) add(scene.goal, scene.goal_radius);
  if (scene.start) add(scene.start);
  if (!half) for (const o of scene.obstacles) add(o.at, o.kind === "wall" ? 0 : 0.5 * Math.hypot(...o.size.slice(0, 2)));
  const [[x0, x1], [y0, y1]] = values.map((list) => [Math.min(...list), Math.max(...list)]);
  const pad = 0.04 * Math.max(x1 - x0, y1 - y0, 0.5);
  return [x0 - pad, y0 - pad, x1 + pad, y1 + pad];
}

/** The scene of an episode at its point `k`. */
function sceneAt(episode, k) {
  const { x, y, z, heading } = episode;
  const movers = episode.movers?.[k] ?? episode.movers?.[k - 1];
  const list = z ? x.map((value, i) => [value, y[i], z[i]]) : x.map((value, i) => [value, y[i]]);
  return { ...episode, points: list, pose: [x[k], y[k], heading?.[k] ?? null, z?.[k]], decision: episode.tubes?.[k], movers };
}

/** The step of the point `k` of an episode: a sketch has only some steps. */
const stepOf = (episode, k) => episode.first + (episode.at ? episode.at[k] : k);

/** The point of an episode nearest to a step. */
function pointOf(episode, step) {
  const wanted = step - episode.first;
  if (!episode.at) return Math.min(episode.x.length - 1, Math.max(0, Math.round(wanted)));
  const away = episode.at.map((index) => Math.abs(index - wanted));
  return away.indexOf(Math.min(...away));
}
