// Draws the live page from the server-sent events at /events. It uses svg.js and scene.js of the report.
"use strict";

const SILENT = 3; // s without a message on the bus after which the page reports silence
const CLOSE = 6; // half-width of the close view, in footprints of the robot
const MAP_SIZE = 600; // px of a map's coordinates
const WINDOW = 20; // episodes in the moving average of the reward
const LETTERS = Object.fromEntries(Object.entries(KINDS).map(([letter, { name }]) => [name, letter]));
const cards = new Map();
const at = (id) => document.getElementById(id);

const number = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const share = (count, of) => (of ? `${count} (${((100 * count) / of).toFixed(1)} %)` : String(count));

/** Return a canvas's context, scaled so that one unit is one CSS pixel, and the canvas's size. */
function clearCanvas(canvas) {
  const { width, height } = canvas.getBoundingClientRect();
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

/** Return the card of a robot; create it when the robot first appears. */
function card(robot) {
  if (!cards.has(robot.actor)) {
    if (cards.size === 0) at("robots").replaceChildren();
    const parts = { episode: element("span"), status: element("p"), reason: element("p", { class: "why" }), map: element("div"), near: element("div") };
    parts.box = element("article", { class: "card", "data-actor": robot.actor }, element("h2", {}, robot.actor, parts.episode), element("div", { class: "maps" }, parts.map, parts.near), parts.status, parts.reason);
    at("robots").append(parts.box);
    cards.set(robot.actor, parts);
  }
  return cards.get(robot.actor);
}

/** The latest state of a robot as a scene for scene.js. */
function sceneOf(robot) {
  const marks = new Map(robot.marks.map(([x, y, kind]) => [`${x},${y}`, LETTERS[kind]]));
  const decision = { from: robot.pose, boxes: robot.tube, arrows: robot.arrows, edge: robot.edge, promises: robot.promises, ...robot.around };
  const kinds = robot.trail.map(([x, y]) => marks.get(`${x},${y}`) ?? (robot.kind ? "l" : "n"));
  return { ...robot.arena, start: null, points: robot.trail, kinds, pose: robot.pose, footprint: robot.footprint, discs: robot.discs, decision };
}

function drawRobot(robot) {
  const { box, episode, map, near, status, reason } = card(robot);
  episode.textContent = `episode ${robot.number}`;
  const words = [robot.kind || "no filter", `reward ${number(robot.reward, 1)}`, `${robot.marks.length} interventions`];
  if (robot.margin !== null) words.push(`margin ${robot.at_least ? "> " : ""}${number(100 * robot.margin, 1)} cm`);
  if (robot.slow) words.push(`slowed down to ${number(100 * robot.slow)} % of its inputs: more plans left their tubes than stated`);
  if (robot.height !== null) words.push(`height ${number(robot.height, 1)} m`);
  if (robot.ended) words.push(`last episode: ${robot.ended}`);
  status.textContent = words.join(" · ");
  const inputs = robot.inputs.map(([name, unit, proposed, executed]) => `${name} ${number(proposed, 2)} → ${number(executed, 2)} ${unit}`);
  reason.textContent = robot.kind === "" ? "" : [robot.said, inputs.join(", "), robot.trust].filter(Boolean).join(" · ");
  const { top, bottom } = box.getBoundingClientRect();
  if (!robot.arena.half || bottom < 0 || top > innerHeight) return; // off the screen: 200 robots must not stall the page
  const scene = sceneOf(robot), edge = 1.04 * robot.arena.half, [x, y] = robot.pose, reach = CLOSE * robot.footprint;
  map.innerHTML = drawScene(scene, [-edge, -edge, edge, edge], MAP_SIZE, `the arena of ${robot.actor}`);
  near.innerHTML = drawScene(scene, [x - reach, y - reach, x + reach, y + reach], MAP_SIZE, `the surroundings of ${robot.actor}`);
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

/** Draw one reward curve for each robot kind: rewards of different tasks are not comparable. */
function drawCurves(all) {
  for (const [robot, returns] of Object.entries(all)) {
    let canvas = document.querySelector(`canvas[data-rewards="${CSS.escape(robot)}"]`);
    if (!canvas) {
      canvas = element("canvas", { "data-rewards": robot, "aria-label": `reward of the latest episodes of ${robot}, and its mean over ${WINDOW} episodes` });
      at("curves").append(element("h3", {}, robot), canvas);
    }
    drawCurve(canvas, returns);
  }
}

function drawCurve(canvas, returns) {
  const { pen, width, height } = clearCanvas(canvas);
  if (returns.length < 2) return;
  const low = Math.min(...returns, 0), high = Math.max(...returns, 1), foot = 14;
  const x = (i) => (i / (returns.length - 1)) * (width - 44) + 40;
  const y = (value) => height - foot - ((value - low) / (high - low)) * (height - foot - 8);
  pen.font = "11px system-ui, sans-serif";
  pen.fillStyle = "#667085";
  pen.textAlign = "right";
  for (const value of [low, 0, high]) pen.fillText(value.toFixed(0), 34, y(value) + 4);
  pen.strokeStyle = "#dfe3ea";
  pen.beginPath();
  pen.moveTo(40, y(0));
  pen.lineTo(width, y(0));
  pen.stroke();
  pen.fillStyle = "rgba(40, 96, 190, 0.35)";
  returns.forEach((value, i) => pen.fillRect(x(i) - 1, y(value) - 1, 2.5, 2.5));
  pen.strokeStyle = "#2860be";
  pen.lineWidth = 2;
  pen.beginPath();
  returns.forEach((_, i) => {
    const last = returns.slice(Math.max(0, i + 1 - WINDOW), i + 1);
    const mean = last.reduce((a, b) => a + b, 0) / last.length;
    if (i) pen.lineTo(x(i), y(mean));
    else pen.moveTo(x(i), y(mean));
  });
  pen.stroke();
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

let drawn = 0;
const events = new EventSource("/events");
events.onmessage = ({ data }) => {
  const view = JSON.parse(data);
  const quiet = view.silent > SILENT;
  if (view.run.outcome) showConnection("ended", `the run has ended: ${view.run.outcome}`);
  else if (quiet) showConnection("down", `no message on the bus for ${view.silent.toFixed(0)} s`);
  else showConnection("up", "live");
  view.robots.forEach(drawRobot);
  drawRun(view);
  drawFigures(view);
  drawCurves(view.returns);
  drawLists(view);
  document.body.dataset.drawn = String((drawn += 1));
};
events.onerror = () => {
  if (at("link").className !== "ended") showConnection("down", "`brakeline watch` does not answer; the page retries");
};
