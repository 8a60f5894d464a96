// Several runs: performance profiles of the groups of runs that differ only in their seed.

/** Draw the share of the runs of each group whose score is above a level, with its interval. */
function profiles(target, groups) {
  for (const robot of [...new Set(groups.map((group) => group.robot))].sort()) {
    const drawn = groups.filter((group) => group.robot === robot && group.profile.share.length);
    if (drawn.length) target.append(profile(robot, drawn));
  }
}

function profile(robot, groups) {
  const frame = { left: 56, right: 472, top: 30, bottom: 178 }, title = `performance profile, ${robot}`;
  const x = scale(0, 1, frame.left, frame.right), y = scale(0, 1, frame.bottom, frame.top);
  const spot = (px, py) => `${px.toFixed(1)},${py.toFixed(1)}`;
  const parts = [label(4, 14, `${title} [share of runs]`, { class: "title" })];
  parts.push(axes(frame, x, y, ticks(0, 1, 5), ticks(0, 1, 4), { x: percents, y: percents }));
  for (const { name, color, profile } of groups) {
    const at = profile.level.map(x);
    if (profile.low) parts.push(tag("polygon", { points: [...at.map((px, k) => spot(px, y(profile.high[k]))), ...at.map((px, k) => spot(px, y(profile.low[k]))).toReversed()].join(" "), fill: color, opacity: 0.15, class: "band" }));
    parts.push(tag("polyline", { points: at.map((px, k) => spot(px, y(profile.share[k]))).join(" "), fill: "none", stroke: color, "stroke-width": 1.8, "data-group": name }));
  }
  parts.push(label(frame.right, 208, "goals of the last 100 episodes are more than this", { "text-anchor": "end" }));
  const box = element("figure", { class: "chart", "data-chart": title });
  box.innerHTML = drawing(496, 214, title, parts);
  hovers(box, (px) => {
    const k = Math.round(Math.min(1, Math.max(0, (px - frame.left) / (frame.right - frame.left))) * 100);
    return px < frame.left ? null : `more than ${percents(groups[0].profile.level[k])} goals\n${groups.map((group) => `${group.name}: ${percent(group.profile.share[k])} of the runs`).join("\n")}`;
  });
  saves(box, title, () => groups.flatMap(({ name, profile }) => profile.level.map((level, k) => ({ group: name, level, share: profile.share[k], low: profile.low?.[k], high: profile.high?.[k] }))));
  return box;
}

/** The curve of a group as a line with a band; null without a point. `name`: of the curve in the group's `curves`. */
function groupLine(group, name) {
  const { step, runs } = group.curves, values = group.curves[name] ?? [];
  const band = values.map((value, k) => ({ step: step[k], runs: runs[k], ...value })).filter((point) => point.mean !== null);
  const many = group.runs.length > 1 ? `, ${group.runs.length} runs` : "";
  return band.length > 1 ? { name: `${group.name}${many}`, color: group.color, band, all: group.runs.length, points: [] } : null;
}
