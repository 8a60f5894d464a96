// Plots of an episode over its time: clearance, and in the air the altitude. A click on a plot goes to that time.

/** The time of the point `k` in s, or its step without a period. */
const timeOf = (episode, k) => stepOf(episode, k) * (episode.period ?? 1);

/** Plot `values` of the episode's points, with a dot for each intervention and a line at the point `k`. */
function strip(episode, k, { title, values, low = 0, lines = [] }) {
  const frame = { left: 40, right: 390, top: 22, bottom: 112 };
  const ends = [...values, ...lines.map(([value]) => value)];
  const least = Math.min(low, ...ends), most = Math.max(least + 0.05, ...ends), last = values.length - 1;
  const [begin, end] = [timeOf(episode, 0), timeOf(episode, last)];
  const x = scale(begin, Math.max(end, begin + 1e-6), frame.left, frame.right), y = scale(least, most, frame.bottom, frame.top);
  const unit = episode.period ? "s" : "step";
  const parts = [label(4, 12, `${title} over time [${unit}]`, { class: "title" }), axes(frame, x, y, ticks(begin, end, 5), ticks(least, most, 3))];
  for (const [value, words] of lines) parts.push(tag("line", { x1: frame.left, x2: frame.right, y1: y(value), y2: y(value), class: "axis", "stroke-dasharray": "4 3" }), label(frame.right, y(value) + (value > least ? 11 : -3), words, { "text-anchor": "end" }));
  parts.push(tag("polyline", { points: values.map((value, i) => `${x(timeOf(episode, i)).toFixed(1)},${y(value).toFixed(1)}`).join(" "), fill: "none", stroke: color("soft"), "stroke-width": 1.3 }));
  values.forEach((value, i) => { if (INTERVENTIONS.includes(episode.kinds[i])) parts.push(tag("circle", { cx: x(timeOf(episode, i)), cy: y(value), r: 2.3, fill: KINDS[episode.kinds[i]].color })); });
  parts.push(tag("line", { x1: x(timeOf(episode, k)), x2: x(timeOf(episode, k)), y1: frame.top, y2: frame.bottom, class: "ink", "stroke-dasharray": "3 3" }));
  const range = { "data-left": frame.left, "data-right": frame.right, "data-begin": begin, "data-end": end };
  return drawing(400, 132, `${title} over the episode`, parts, range);
}

/** The plots of an episode: name and SVG. */
function plotsOf(episode, k) {
  const plots = [["clearance", strip(episode, k, { title: "clearance [m]", values: episode.clearance })]];
  if (!episode.z) return plots;
  const lines = [[episode.floor, "floor"], [episode.ceiling, "ceiling"]].filter(([height]) => typeof height === "number");
  return [...plots, ["altitude", strip(episode, k, { title: "altitude [m]", values: episode.z, lines })]];
}

/** The point of the episode at a click on one of its plots. */
function pointAtClick(episode, event) {
  const svg = event.target.closest("svg");
  if (!svg?.dataset.left) return null;
  const { left, right, begin, end } = svg.dataset;
  const time = +begin + ((pointIn(svg, event)[0] - left) / (right - left)) * (end - begin);
  return pointOf(episode, time / (episode.period ?? 1));
}
