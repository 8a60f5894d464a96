// Draws the live page from the server-sent events at /events. It shares the viewer with the report.
"use strict";

const SILENT = 3; // s without a message on the bus after which the page reports silence
const CLOSE = 6; // half-width of the close view, in footprints of the robot
const MAP_SIZE = 600; // px of a map's coordinates
const COLUMNS = ["steps", "episodes", "goals", "collisions", "interventions", "reward"]; // of a row of a history
const cards = new Map();
let pointed = null; // the card under the pointer
const at = (id) => document.getElementById(id);

const number = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const share = (count, of) => (of ? `${count} (${((100 * count) / of).toFixed(1)} %)` : String(count));

/** Return the card of a robot; create it when the robot first appears. */
function card(robot) {
  if (!cards.has(robot.actor)) {
    if (cards.size === 0) at("robots").replaceChildren();
    const parts = { episode: element("span"), status: element("p"), reason: element("p", { class: "why" }), near: element("div", { class: "near" }) };
    const stage = element("div");
    parts.viewer = new Viewer(stage);
    const box = element("article", { class: "card", "data-actor": robot.actor }, element("h2", {}, robot.actor, parts.episode), stage, element("div", { class: "beside" }, parts.near, parts.viewer.plots), parts.status, parts.reason);
    box.addEventListener("pointerenter", () => { pointed = parts; });
    parts.box = box;
    at("robots").append(box);
    cards.set(robot.actor, parts);
  }
  return cards.get(robot.actor);
}

/** The running episode of a robot, for the viewer. */
function episodeOf(robot) {
  const { path, pose, tube, arena } = robot, last = Math.max(0, robot.kinds.length - 1);
  const decision = { from: pose.slice(0, path.z ? 3 : 2), boxes: tube, arrows: robot.arrows, edge: robot.edge, reservations: robot.reservations, ...robot.around };
  const begun = robot.kinds.length > 0, flat = !path.z;
  return {
    ...arena, start: robot.first ? null : arena.start, actor: robot.actor, robot: robot.robot, episode: robot.number, first: robot.first, period: robot.period,
    footprint: robot.footprint, discs: robot.discs, kinds: begun ? robot.kinds : "n", clearance: begun ? robot.clearance : [0],
    x: begun ? path.x : [pose[0]], y: begun ? path.y : [pose[1]], z: flat ? null : begun ? path.z : [pose[2]],
    heading: robot.heading && (begun ? robot.heading : [pose.at(-1)]), tubes: tube.length || robot.reservations.length || robot.around.hits?.length || robot.around.movers?.length ? { [last]: decision } : {},
  };
}

function drawRobot(robot) {
  const { box, episode, viewer, near, status, reason } = card(robot);
  episode.textContent = `episode ${robot.number}`;
  box.classList.toggle("stuck", robot.stuck > 0);
  const words = [[robot.kind || "no filter", robot.kind === "allowed" ? robot.limited : ""].filter(Boolean).join(", "), `reward ${number(robot.reward, 1)}`, `${robot.interventions} interventions`];
  if (robot.margin !== null) words.push(`margin ${robot.at_least ? "> " : ""}${number(100 * robot.margin, 1)} cm`);
  if (robot.slow) words.push(`slowed down to ${number(100 * robot.slow)} % of its inputs: more plans left their tubes than stated`);
  if (robot.path.z) words.push(`height ${number(robot.pose[2], 1)} m`);
  if (robot.ended) words.push(`last episode: ${robot.ended}`);
  status.textContent = words.join(" · ");
  const inputs = robot.inputs.map(([name, unit, proposed, executed]) => `${name} ${number(proposed, 2)} → ${number(executed, 2)} ${unit}`);
  reason.textContent = robot.kind === "" ? "" : [robot.said, inputs.join(", "), robot.trust].filter(Boolean).join(" · ");
  const { top, bottom } = box.getBoundingClientRect();
  if (!robot.arena.half || bottom < 0 || top > innerHeight) return; // off the screen: 200 robots must not stall the page
  const key = JSON.stringify([robot.number, robot.first, robot.kinds.length, robot.pose, robot.tube[0], robot.reservations]);
  if (box.dataset.shown === key) return; // nothing has moved since the last event
  box.dataset.shown = key;
  const shown = episodeOf(robot), [x, y] = robot.pose, reach = CLOSE * robot.footprint;
  viewer.refresh(shown);
  near.innerHTML = drawScene(sceneAt(shown, shown.x.length - 1), [x - reach, y - reach, x + reach, y + reach], MAP_SIZE, `the surroundings of ${robot.actor}`);
}

/** Name the robots that are stuck. */
function drawStuck(robots) {
  const stuck = robots.filter((robot) => robot.stuck > 0);
  at("stuck").replaceChildren(...stuck.map((robot) => element("li", {}, `${robot.actor} is stuck: for ${robot.stuck} steps (${number(robot.stuck * robot.period)} s) it has stayed within ${figure(robot.footprint)} m${robot.said ? `. Latest decision: ${robot.said}` : ""}`)));
}

/** One tile for each count of a robot kind. */
function tiles(robot, counts, learner) {
  const pairs = [
    ["steps", number(counts.steps)],
    ["episodes", number(counts.episodes)],
    ["goals", share(counts.goals, counts.episodes)],
    ["collisions", number(counts.collisions)],
    ["interventions", share(counts.interventions, counts.steps)],
    ["failsafes", number(counts.failsafes)],
    ["mean reward per episode", number(counts.mean_reward, 1)],
  ];
  if (learner) {
    pairs.push(["steps used for learning", `${learner.steps} (${number(learner.steps_per_s)}/s)`]);
    pairs.push(["updates", `${learner.updates} (${number(learner.updates_per_s)}/s)`]);
  }
  return pairs.map(([name, value]) => {
    const bad = name === "collisions" && counts.collisions > 0;
    return element("div", { class: bad ? "bad" : "" }, element("dt", {}, name), element("dd", {}, value));
  });
}

function drawFigures(view) {
  const robots = Object.entries(view.totals);
  at("figures").replaceChildren(
    ...robots.map(([robot, counts]) => {
      const grid = element("dl", {}, ...tiles(robot, counts, view.learners[robot]));
      return element("div", { class: "group", "data-robot": robot }, element("h2", {}, robot), grid);
    }),
  );
  const times = `decision p50 / p99: ${number(view.decide.p50, 2)} / ${number(view.decide.p99, 2)} ms since the start of \`brakeline watch\``;
  const scope = view.since === null ? "Counts cover the whole run." : `Counts cover only the ${view.since.toFixed(0)} s that were watched: no launcher reports earlier steps.`;
  const { flown, outside, stated } = view.plans;
  const left = flown ? ` The robots followed ${flown} verified plans and left the tube of ${outside} of them (${stated}).` : "";
  at("scope").textContent = view.decide.p50 === null ? scope : `${scope} ${times}.${left}`;
}

/** Show the run's name, its configuration and its progress. */
function drawRun(view) {
  const { run, method, arena, seed, steps } = view.run;
  at("run").textContent = run ? `${run}: method ${method}, arena ${arena}, seed ${seed}` : "";
  const learners = Object.values(view.learners);
  const counted = learners.length ? learners : Object.values(view.totals);
  const done = counted.reduce((total, one) => total + one.steps, 0);
  at("progress").hidden = !steps;
  at("progress").max = steps || 1;
  at("progress").value = done;
  at("done").textContent = steps ? `${done} of ${steps} steps (${((100 * done) / steps).toFixed(0)} %)` : "";
}

/** What a curve shows of the steps between two rows of a history. */
const HISTORIES = [
  { title: "goals reached", unit: "share of episodes", of: (d) => d.episodes ? d.goals / d.episodes : null, form: percents, color: "goal", high: 1 },
  { title: "reward of an episode", unit: "mean", of: (d) => d.episodes ? d.reward / d.episodes : null, form: figure, color: "ink" },
  { title: "interventions", unit: "share of steps", of: (d) => d.interventions / d.steps, form: percents, color: "adjusted" },
  { title: "collisions", unit: "count so far", of: (d, now) => now.collisions, form: figure, color: "failsafe" },
];

/** Draw the histories of each robot kind: rewards of different tasks are not comparable. */
function drawCurves(history, totals) {
  for (const [robot, rows] of Object.entries(history)) {
    let box = document.querySelector(`[data-history="${CSS.escape(robot)}"]`);
    if (!box) {
      box = element("div", { class: "charts", "data-history": robot });
      at("curves").append(...(Object.keys(history).length > 1 ? [element("h3", {}, robot)] : []), box);
    }
    const named = rows.map((row) => Object.fromEntries(COLUMNS.map((name, i) => [name, row[i]]))), now = totals[robot];
    if (now && now.steps > (named.at(-1)?.steps ?? 0)) {
      const apart = named.length > 1 ? named.at(-1).steps - named.at(-2).steps : 0;
      if (named.length > 1 && now.steps - named.at(-1).steps < 0.7 * apart) named.pop(); // few steps would show mostly noise
      named.push({ ...now, reward: (now.mean_reward ?? 0) * now.episodes });
    }
    const key = `${named.length} ${named.at(-1)?.steps}`;
    if (box.dataset.drawn === key) continue;
    box.dataset.drawn = key;
    box.innerHTML = HISTORIES.map((what) => historyChart(named, what)).join("");
  }
}

function historyChart(rows, { title, unit, of, form, color: name, high }) {
  const box = { left: 48, right: 386, top: 24, bottom: 120 }, zero = Object.fromEntries(COLUMNS.map((column) => [column, 0]));
  const values = rows.map((row, i) => { const before = rows[i - 1] ?? zero; return [row.steps, of(Object.fromEntries(COLUMNS.map((c) => [c, row[c] - before[c]])), row)]; }).filter(([, value]) => value !== null);
  const low = Math.min(0, ...values.map(([, v]) => v)), most = high ?? Math.max(low + 1e-3, 1.1 * Math.max(...values.map(([, v]) => v), 0)), end = Math.max(1, rows.at(-1)?.steps ?? 1);
  const top = title === "collisions" ? Math.max(1, most) : most, x = scale(0, end, box.left, box.right), y = scale(low, top, box.bottom, box.top);
  const path = values.map(([steps, v]) => `${x(steps).toFixed(1)},${y(v).toFixed(1)}`).join(" ");
  return drawing(396, 142, title, [label(4, 14, `${title} [${unit}]`, { class: "title" }), axes(box, x, y, ticks(0, end, 4), ticks(low, top, 3), { y: form, x: (v) => v >= 1000 ? `${figure(v / 1000)}k` : figure(v) }), tag("polyline", { points: path, fill: "none", stroke: color(name), "stroke-width": 2 }), ...values.slice(-1).map(([steps, v]) => tag("circle", { cx: x(steps), cy: y(v), r: 2.5, fill: color(name) }))], { "data-points": values.length });
}

function drawLists(view) {
  const processes = Object.entries(view.processes);
  at("processes").replaceChildren(
    ...processes.map(([name, state]) => element("li", { class: state }, state === "alive" ? name : `${name}: ${state}`)),
  );
  at("lines").replaceChildren(...view.lines.map((line) => element("li", {}, line)));
}

function showConnection(state, words) {
  at("link").className = state;
  at("link").textContent = words;
}

/** The card that keys are meant for: the one under the pointer, else the first one in the window. */
function chosenCard() {
  const inside = ({ box }) => { const { top, bottom } = box.getBoundingClientRect(); return bottom > 0 && top < innerHeight; };
  return pointed ?? [...cards.values()].find(inside);
}

const keys = listenToKeys((event) => { const viewer = chosenCard()?.viewer; return Boolean(viewer?.episode) && viewer.key(event); });
at("keys-button").addEventListener("click", keys);
at("legend").append(legend([...viewerLegend(), ...[["free", "free space by the scan"], ["mover", "moving obstacle and its reachable set"], ["reserved", "reserved by other robots"]].map(([name, words]) => [color(name), words])]));

let drawn = 0;
const events = new EventSource("/events");
events.onmessage = ({ data }) => {
  const view = JSON.parse(data);
  const quiet = view.silent > SILENT;
  at("report").hidden = !(view.run.outcome && view.report);
  if (view.run.outcome) showConnection("ended", `the run has ended: ${view.run.outcome}`);
  else if (quiet) showConnection("down", `no message on the bus for ${view.silent.toFixed(0)} s`);
  else showConnection("up", "live");
  if (!document.hidden) view.robots.forEach(drawRobot);
  drawRun(view);
  drawFigures(view);
  drawStuck(view.robots);
  drawCurves(view.history, view.totals);
  drawLists(view);
  document.body.dataset.drawn = String((drawn += 1));
};
events.onerror = () => {
  if (at("link").className !== "ended") showConnection("down", "`brakeline watch` does not answer; the page retries");
};
