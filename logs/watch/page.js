// Draws what /events says: a map for each robot, figures, rewards, processes, warnings.
"use strict";

const COLORS = { allowed: "#34a864", adjusted: "#f0961e", failsafe: "#d6303c", recovering: "#8e44ad", "": "#8a93a3" };
const ARROWS = ["#c77d00", "#1f5fbf"]; // proposed, executed
const EDGE = "#c02030"; // of what the proposal would have crossed
const FREE = "#148c78", HIT = "#5a288c", MOVER = "#aa5a28", PROMISE = "#2860be"; // what the filter was told
const SILENT = 3; // s without a message on the bus after which the run counts as quiet
const CLOSE = 6; // footprints from the robot to the edge of the close view
const WINDOW = 20; // episodes that the reward's mean is over
const cards = new Map();
const at = (id) => document.getElementById(id);

const number = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const share = (count, of) => (of ? `${count} (${((100 * count) / of).toFixed(1)} %)` : String(count));

function element(kind, text = "", name = "") {
  const made = document.createElement(kind);
  made.textContent = text;
  if (name) made.className = name;
  return made;
}

/** A canvas's context, scaled so that one unit is a CSS pixel; and its size. */
function fresh(canvas) {
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

function card(robot) {
  if (!cards.has(robot.actor)) {
    if (cards.size === 0) at("robots").replaceChildren();
    const box = element("article", "", "card");
    box.dataset.actor = robot.actor;
    const title = element("h2", robot.actor);
    const made = { episode: element("span"), note: element("p"), why: element("p", "", "why"), map: element("canvas"), near: element("canvas") };
    made.map.setAttribute("aria-label", `the arena of ${robot.actor}`);
    made.near.setAttribute("aria-label", `what is about ${robot.actor}`);
    const maps = element("div", "", "maps");
    maps.append(made.map, made.near);
    title.append(made.episode);
    box.append(title, maps, made.note, made.why);
    at("robots").append(box);
    cards.set(robot.actor, made);
  }
  return cards.get(robot.actor);
}

function drawRobot(robot) {
  const { episode, map, near, note, why } = card(robot);
  episode.textContent = `episode ${robot.number}`;
  const words = [robot.kind || "no filter", `reward ${number(robot.reward, 1)}`, `stepped in ${robot.marks.length} ×`];
  if (robot.margin !== null) words.push(`margin ${robot.at_least ? "> " : ""}${number(100 * robot.margin, 1)} cm`);
  if (robot.height !== null) words.push(`height ${number(robot.height, 1)} m`);
  if (robot.ended) words.push(`before: ${robot.ended}`);
  note.textContent = words.join(" · ");
  const inputs = robot.inputs.map(([name, unit, proposed, executed]) => `${name} ${number(proposed, 2)} → ${number(executed, 2)} ${unit}`);
  why.textContent = robot.kind === "" ? "" : [robot.said, inputs.join(", "), robot.trust].filter(Boolean).join(" · ");
  if (!robot.arena.half) return;
  drawMap(map, robot, [0, 0], 1.04 * robot.arena.half);
  drawMap(near, robot, robot.pose, CLOSE * robot.footprint);
}

/** What is within `half` m of a point, to the sides and up and down. */
function drawMap(canvas, robot, [x, y], half) {
  const { pen, width, height } = fresh(canvas);
  const scale = Math.min(width, height) / (2 * half); // px a metre
  pen.translate(width / 2, height / 2);
  pen.scale(scale, -scale); // metres, y up
  pen.translate(-x, -y);
  pen.lineWidth = 1.5 / scale;
  drawArena(pen, robot.arena, scale);
  drawAround(pen, robot, scale);
  drawWay(pen, robot, scale);
  drawBody(pen, robot, scale);
  drawTube(pen, robot, scale);
  drawExplained(pen, robot, scale);
}

/** What was asked for and what was done as arrows, and the edge of what stood in the way. */
function drawExplained(pen, robot, scale) {
  const [x, y] = robot.pose, reach = 2.5 * robot.footprint;
  if (robot.edge.length && Math.hypot(robot.edge[2], robot.edge[3]) > 0.2) {
    const [px, py, nx, ny] = robot.edge;
    const flat = Math.hypot(nx, ny), ux = nx / flat, uy = ny / flat;
    const stroke = (a1, b1, a2, b2, width) => {
      pen.lineWidth = width / scale;
      pen.beginPath();
      pen.moveTo(px - a1 * uy + b1 * ux, py + a1 * ux + b1 * uy);
      pen.lineTo(px - a2 * uy + b2 * ux, py + a2 * ux + b2 * uy);
      pen.stroke();
    };
    pen.strokeStyle = EDGE;
    stroke(-reach, 0, reach, 0, 2);
    for (let i = -4; i <= 4; i++) stroke((i / 4.5) * reach, 0, (i / 4.5 + 0.12) * reach, 0.16 * reach, 1);
  }
  robot.arrows.forEach(([dx, dy], i) => {
    const length = Math.hypot(dx, dy);
    pen.strokeStyle = ARROWS[i];
    pen.lineWidth = 2 / scale;
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + dx, y + dy);
    if (length > 3 / scale) {
      const head = Math.min(7 / scale, 0.5 * length), ux = dx / length, uy = dy / length;
      pen.moveTo(x + dx - head * ux + 0.5 * head * uy, y + dy - head * uy - 0.5 * head * ux);
      pen.lineTo(x + dx, y + dy);
      pen.lineTo(x + dx - head * ux - 0.5 * head * uy, y + dy - head * uy + 0.5 * head * ux);
    }
    pen.stroke();
  });
}

function drawArena(pen, arena, scale) {
  const half = arena.half;
  pen.strokeStyle = "#667085";
  pen.strokeRect(-half, -half, 2 * half, 2 * half);
  pen.fillStyle = "#c3c9d4";
  for (const { kind, at: [x, y], size, yaw } of arena.obstacles) {
    pen.save();
    pen.translate(x, y);
    pen.rotate(yaw);
    pen.beginPath();
    if (kind === "box") pen.rect(-size[0] / 2, -size[1] / 2, size[0], size[1]);
    else pen.arc(0, 0, size[0], 0, 2 * Math.PI);
    pen.fill();
    pen.restore();
  }
  pen.beginPath();
  pen.arc(arena.goal[0], arena.goal[1], arena.goal_radius, 0, 2 * Math.PI);
  pen.fillStyle = "rgba(52, 168, 100, 0.18)";
  pen.fill();
  pen.strokeStyle = COLORS.allowed;
  pen.lineWidth = 2 / scale;
  pen.stroke();
}

/** What a scan hit and showed to be free, what moves and may come to where, where other robots promise to be. */
function drawAround(pen, { around, promises }, scale) {
  const { hits = [], free = [], movers = [], swept = [] } = around;
  pen.lineWidth = 1.5 / scale;
  if (free.length) {
    pen.beginPath();
    free.forEach(([x, y]) => pen.lineTo(x, y));
    pen.closePath();
    pen.strokeStyle = FREE;
    pen.stroke();
    pen.fillStyle = "rgba(20, 140, 120, 0.07)";
    pen.fill();
  }
  pen.fillStyle = HIT;
  for (const [x, y] of hits) pen.fillRect(x - 1.2 / scale, y - 1.2 / scale, 2.4 / scale, 2.4 / scale);
  const disc = ([x, y, radius]) => {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.fill();
  };
  pen.fillStyle = MOVER;
  pen.globalAlpha = 0.12;
  swept.flat().forEach(disc);
  pen.globalAlpha = 0.8;
  movers.forEach(disc);
  pen.fillStyle = pen.strokeStyle = PROMISE;
  for (const [x, y, dx, dy] of promises) {
    pen.globalAlpha = 0.12;
    pen.fillRect(x - dx, y - dy, 2 * dx, 2 * dy);
    pen.globalAlpha = 0.5;
    pen.strokeRect(x - dx, y - dy, 2 * dx, 2 * dy);
  }
  pen.globalAlpha = 1;
}

function drawWay(pen, robot, scale) {
  pen.lineWidth = 1.5 / scale;
  pen.strokeStyle = "rgba(40, 96, 190, 0.45)";
  pen.beginPath();
  robot.trail.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.stroke();
  for (const [x, y, kind] of robot.marks) {
    pen.fillStyle = COLORS[kind];
    pen.beginPath();
    pen.arc(x, y, 2.5 / scale, 0, 2 * Math.PI);
    pen.fill();
  }
}

function drawTube(pen, robot, scale) {
  const color = COLORS[robot.kind];
  robot.tube.forEach(([x, y, dx, dy], i) => {
    const around = robot.footprint; // of the last one, where it comes to a stop, with the body about it
    pen.fillStyle = pen.strokeStyle = color;
    if (i === robot.tube.length - 1) {
      pen.globalAlpha = 0.3;
      pen.beginPath();
      pen.roundRect(x - dx - around, y - dy - around, 2 * (dx + around), 2 * (dy + around), around);
      pen.fill();
    }
    pen.globalAlpha = 0.5;
    pen.fillRect(x - dx, y - dy, 2 * dx, 2 * dy);
    pen.globalAlpha = 1;
    pen.lineWidth = 1 / scale;
    pen.strokeRect(x - dx, y - dy, 2 * dx, 2 * dy);
  });
}

function drawBody(pen, robot, scale) {
  const [x, y, heading] = robot.pose;
  const cos = Math.cos(heading), sin = Math.sin(heading), radius = Math.max(robot.footprint, 3 / scale);
  pen.fillStyle = "#2860be";
  for (const [ahead, aside, size] of robot.discs) {
    pen.beginPath();
    pen.arc(x + ahead * cos - aside * sin, y + ahead * sin + aside * cos, Math.max(size, 3 / scale), 0, 2 * Math.PI);
    pen.fill();
  }
  pen.strokeStyle = "#fff";
  pen.lineWidth = 2 / scale;
  pen.beginPath();
  pen.moveTo(x, y);
  pen.lineTo(x + radius * cos, y + radius * sin);
  pen.stroke();
}

/** A tile for each figure of a robot kind: counts of the whole run where the launcher tells them. */
function tiles(robot, counts, learner) {
  const pairs = [
    ["steps driven", number(counts.steps)],
    ["episodes", number(counts.episodes)],
    ["goals", share(counts.goals, counts.episodes)],
    ["collisions", number(counts.collisions)],
    ["interventions", share(counts.interventions, counts.steps)],
    ["of these failsafe", number(counts.failsafes)],
    ["mean reward of an episode", number(counts.mean_reward, 1)],
  ];
  if (learner) {
    pairs.push(["steps learned from", `${learner.steps} (${number(learner.steps_per_s)}/s)`]);
    pairs.push(["updates", `${learner.updates} (${number(learner.updates_per_s)}/s)`]);
  }
  return pairs.map(([name, value]) => {
    const box = element("div", "", name === "collisions" && counts.collisions > 0 ? "bad" : "");
    box.append(element("dt", name), element("dd", value));
    return box;
  });
}

function drawFigures(view) {
  const robots = Object.entries(view.totals);
  at("figures").replaceChildren(
    ...robots.map(([robot, counts]) => {
      const group = element("div", "", "group");
      group.dataset.robot = robot;
      const grid = element("dl");
      grid.append(...tiles(robot, counts, view.learners[robot]));
      group.append(element("h2", robot), grid);
      return group;
    }),
  );
  const times = `decision p50 / p99: ${number(view.decide.p50, 2)} / ${number(view.decide.p99, 2)} ms, since this page's server listens`;
  const scope = view.since === null ? "Counts are of the whole run since it was started." : `Counts are of the ${view.since.toFixed(0)} s that were watched: no launcher tells of what was before.`;
  const { flown, outside, stated } = view.plans;
  const left = flown ? ` Of ${flown} verified plans that were gone on along, ${outside} were left (${stated}).` : "";
  at("scope").textContent = view.decide.p50 === null ? scope : `${scope} ${times}.${left}`;
}

/** The run's name, how it is set up, and how far it is. */
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

/** A curve for each robot kind: rewards of different tasks are not compared. */
function drawCurves(all) {
  for (const [robot, returns] of Object.entries(all)) {
    let canvas = document.querySelector(`canvas[data-rewards="${CSS.escape(robot)}"]`);
    if (!canvas) {
      canvas = element("canvas");
      canvas.dataset.rewards = robot;
      canvas.setAttribute("aria-label", `reward of the latest episodes of ${robot}, and its mean over ${WINDOW}`);
      at("curves").append(element("h3", robot), canvas);
    }
    drawCurve(canvas, returns);
  }
}

function drawCurve(canvas, returns) {
  const { pen, width, height } = fresh(canvas);
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
    ...processes.map(([name, state]) => element("li", state === "alive" ? name : `${name}: ${state}`, state)),
  );
  at("lines").replaceChildren(...view.lines.map((line) => element("li", line)));
}

function say(state, words) {
  at("link").className = state;
  at("link").textContent = words;
}

let drawn = 0;
const events = new EventSource("/events");
events.onmessage = ({ data }) => {
  const view = JSON.parse(data);
  const quiet = view.silent > SILENT;
  if (view.run.outcome) say("ended", `the run has ended: ${view.run.outcome}`);
  else if (quiet) say("down", `nothing on the bus for ${view.silent.toFixed(0)} s`);
  else say("up", "live");
  view.robots.forEach(drawRobot);
  drawRun(view);
  drawFigures(view);
  drawCurves(view.returns);
  drawLists(view);
  document.body.dataset.drawn = String((drawn += 1));
};
events.onerror = () => {
  if (at("link").className !== "ended") say("down", "`brakeline watch` does not answer; trying again");
};
