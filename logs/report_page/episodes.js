// The nearest misses, and the picker of episodes.

/** The smallest rectangle that holds an episode: its path, start, goal and obstacles. */
function episodeBounds(episode) {
  const xs = [...episode.x], ys = [...episode.y];
  const add = (x, y, reach = 0) => { xs.push(x - reach, x + reach); ys.push(y - reach, y + reach); };
  if (episode.goal) add(...episode.goal, episode.goal_radius);
  if (episode.start) add(...episode.start);
  for (const o of episode.obstacles) add(o.at[0], o.at[1], o.kind === "wall" ? 0 : 0.5 * Math.hypot(...o.size.slice(0, 2)));
  const pad = 0.04 * Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 0.5);
  return [Math.min(...xs) - pad, Math.min(...ys) - pad, Math.max(...xs) + pad, Math.max(...ys) + pad];
}

/** The episode at step `k` as an SVG, within `bounds` or all of it. */
function drawEpisode(episode, k, size, bounds = episodeBounds(episode)) {
  const { x, y, heading, tubes } = episode;
  const scene = { ...episode, points: x.map((value, i) => [value, y[i]]), pose: [x[k], y[k], heading?.[k] ?? null], decision: tubes[k] };
  return drawScene(scene, bounds, size, `${episode.actor}, episode ${episode.episode}, step ${episode.first + k}`, k);
}

function why(episode, k) {
  const t = episode.tubes[k];
  if (!t) return KINDS[episode.kinds[k]].name;
  const inputs = t.inputs?.map(([name, unit, proposed, executed]) => `${name} ${figure(proposed)} → ${figure(executed)} ${unit}`) ?? [`${t.proposed.join(", ")} → ${t.plan.join(", ")}`];
  const reason = (episode.kinds[k] !== "l" && t.said) || t.reason;
  return `${KINDS[episode.kinds[k]].name}${reason ? `: ${reason}` : ""}; proposed → executed: ${inputs.join(", ")}; margin ${t.at_least ? "> " : ""}${figure(100 * t.margin)} cm${t.trust ? `; ${t.trust}` : ""}`;
}

/** Draw the nearest misses of all robot kinds, the smallest clearance first. */
function near(target, galleries, choose) {
  const misses = Object.entries(galleries).flatMap(([robot, { near: orders, episodes }]) => orders.map((order) => ({ robot, order, episode: episodes.find((e) => e.order === order) })));
  for (const { robot, order, episode } of misses.sort((a, b) => a.episode.closest - b.episode.closest)) {
    const k = episode.closest_at;
    const reach = Math.max(0.1, 3.4 * episode.footprint, 1.3 * Math.max(0, ...(episode.tubes[k]?.boxes ?? []).map(([x, y]) => Math.hypot(x - episode.x[k], y - episode.y[k]))));
    const bounds = [episode.x[k] - reach, episode.y[k] - reach, episode.x[k] + reach, episode.y[k] + reach];
    const picture = element("div");
    picture.innerHTML = drawEpisode(episode, k, 260, bounds);
    picture.querySelector("svg").setAttribute("width", "100%");
    const facts = element("p", {}, element("b", {}, `${figure(100 * episode.closest)} cm`), ` ${episode.actor}, episode ${episode.episode}, step ${episode.first + k} (${episode.outcome}) `);
    facts.append(element("button", { onclick: () => choose(robot, order, k) }, "show"));
    target.append(element("div", { class: "card", "data-closest": episode.closest }, picture, facts, element("p", { class: "why" }, why(episode, k))));
  }
  if (!target.children.length) target.append(nothing("The log has no episode with a clearance."));
}

/** Plot the clearance over the steps of an episode, coloured by decision. */
function strip(episode, k) {
  const frame = { left: 40, right: 390, top: 22, bottom: 112 };
  const most = Math.max(0.05, ...episode.clearance);
  const x = scale(0, Math.max(1, episode.steps - 1), frame.left, frame.right), y = scale(0, most, frame.bottom, frame.top);
  const parts = [label(4, 12, "clearance [m] over steps", { class: "title" }), axes(frame, x, y, ticks(0, episode.steps - 1, 5).filter(Number.isInteger), ticks(0, most, 3))];
  parts.push(tag("polyline", { points: episode.clearance.map((c, i) => `${x(i).toFixed(1)},${y(c).toFixed(1)}`).join(" "), fill: "none", stroke: "#5d6b7c", "stroke-width": 1.3 }));
  episode.clearance.forEach((c, i) => { if ("dae".includes(episode.kinds[i])) parts.push(tag("circle", { cx: x(i), cy: y(c), r: 2.3, fill: KINDS[episode.kinds[i]].color })); });
  parts.push(tag("line", { x1: x(k), x2: x(k), y1: frame.top, y2: frame.bottom, class: "ink", "stroke-dasharray": "3 3" }));
  return drawing(400, 132, "clearance over the episode", parts);
}

class Picker {
  /** `mark` is a prefix for element ids of this run; `onshow(order, step)` is called for each step that is shown. */
  constructor(target, galleries, mark, onshow) {
    this.target = target;
    this.onshow = onshow;
    this.all = Object.entries(galleries).flatMap(([robot, { near: nearest, episodes }]) => episodes.map((episode) => ({ robot, episode, near: nearest.indexOf(episode.order) })));
    if (!this.all.length) return void target.append(nothing("The log has no episode."));
    this.select = element("select", { "aria-label": "episode", onchange: () => this.show(+this.select.value) });
    this.all.forEach(({ episode: e, near: rank }, i) => {
      const marks = [e.outcome, `${e.steps} steps`, e.failsafes ? `${e.failsafes} failsafe` : "", rank >= 0 ? `near miss ${rank + 1}` : ""].filter(Boolean);
      this.select.append(element("option", { value: i }, `${e.actor}, episode ${e.episode}: ${marks.join(", ")}`));
    });
    const move = (by) => this.show((this.at + by + this.all.length) % this.all.length);
    this.slider = element("input", { type: "range", min: 0, "aria-label": "step", oninput: () => this.step(+this.slider.value) });
    this.play = element("button", { onclick: () => this.toggle() }, "play");
    target.append(element("div", { class: "bar" }, element("button", { onclick: () => move(-1), "aria-label": "previous episode" }, "‹"), this.select, element("button", { onclick: () => move(1), "aria-label": "next episode" }, "›"), this.play, this.slider));
    this.map = element("div", { id: `${mark}episode-map`, class: "episode-map", tabindex: 0, "aria-label": "Episode from above. Left and right arrow: step. Up and down arrow: episode. Space: play.", onkeydown: (event) => this.key(event) });
    this.facts = element("dl", { class: "facts", id: `${mark}episode-facts` });
    this.strip = element("div");
    const map = element("div", {}, this.map), course = element("div", { class: "course" }, this.strip);
    saves(map, "an episode from above");
    saves(course, "clearance over the episode", () => this.rows());
    target.append(element("div", { class: "split" }, map, element("div", {}, this.facts, course)));
    target.append(legend([...["l", "d", "a", "e"].map((k) => [KINDS[k].color, KINDS[k].name]), [TUBE, "tube and plan"], [ARROWS[0], "→ proposed"], [ARROWS[1], "→ executed"], [EDGE, "edge of the half-space that blocks the proposal"], [GOAL, "goal"], [OBSTACLE, "obstacles"], ...this.perceivedLegend()]));
    const wanted = this.all.findIndex(({ episode }) => episode.rows);
    this.show(wanted >= 0 ? wanted : Math.max(0, this.all.findIndex(({ near: rank }) => rank === 0)));
  }

  /** The steps of the episode that is shown, for a CSV. */
  rows() {
    const { episode: e } = this.all[this.at];
    return e.clearance.map((clearance, k) => ({ step: e.first + k, x_m: e.x[k], y_m: e.y[k], speed_m_s: e.speed[k], clearance_m: clearance, decision: KINDS[e.kinds[k]].name }));
  }

  /** Legend of the perceived surroundings that at least one picture of the page shows. */
  perceivedLegend() {
    const parts = [["free", FREE, "free space by the scan"], ["hits", HIT, "hits of the scan"], ["movers", MOVER, "moving obstacle and its reachable set"], ["promises", PROMISE, "reserved by other robots"]];
    return parts.filter(([name]) => this.all.some(({ episode }) => Object.values(episode.tubes).some((t) => t[name]))).map(([, color, words]) => [color, words]);
  }

  choose(robot, order, k) {
    this.show(this.all.findIndex((item) => item.robot === robot && item.episode.order === order), k);
    this.target.closest("section").scrollIntoView({ behavior: "smooth" });
  }

  show(index, k = null) {
    this.stop();
    this.at = index;
    this.select.value = String(index);
    const { episode } = this.all[index];
    this.slider.max = episode.steps - 1;
    this.step(k ?? episode.closest_at);
  }

  step(k) {
    const { episode: e } = this.all[this.at];
    this.k = k;
    this.slider.value = k;
    this.map.innerHTML = drawEpisode(e, k, 600);
    this.strip.innerHTML = strip(e, k);
    const facts = {
      actor: e.actor, episode: e.episode, arena: e.arena ?? "not in the log", outcome: e.outcome, steps: e.steps, reward: figure(e.reward, 4),
      interventions: `${e.interventions}, ${e.failsafes} of them failsafe`, "closest approach": e.closest === null ? "–" : `${figure(100 * e.closest)} cm at step ${e.first + e.closest_at}`,
      step: e.first + k, position: `${figure(e.x[k])}, ${figure(e.y[k])} m`, speed: `${figure(e.speed[k])} m/s`, clearance: `${figure(100 * e.clearance[k])} cm`, decision: why(e, k),
    };
    this.onshow(e.order, e.first + k);
    this.facts.replaceChildren(...Object.entries(facts).flatMap(([name, value]) => [element("dt", {}, name), element("dd", { "data-fact": name }, String(value))]));
  }

  /** Left and right change the step, up and down the episode; space plays. */
  key(event) {
    const steps = this.all[this.at].episode.steps;
    const moves = {
      ArrowRight: () => this.step(Math.min(steps - 1, this.k + 1)),
      ArrowLeft: () => this.step(Math.max(0, this.k - 1)),
      ArrowDown: () => this.show((this.at + 1) % this.all.length),
      ArrowUp: () => this.show((this.at + this.all.length - 1) % this.all.length),
      Home: () => this.step(0),
      End: () => this.step(steps - 1),
      " ": () => this.toggle(),
    };
    if (!moves[event.key]) return;
    event.preventDefault();
    if (event.key !== " ") this.stop();
    moves[event.key]();
  }

  /** Show the episode with this place in the log at this step; return false if the page does not have it. */
  jump(order, step) {
    const place = this.all?.findIndex(({ episode }) => episode.order === order) ?? -1;
    if (place < 0) return false;
    const { first, steps } = this.all[place].episode;
    this.show(place, Math.min(steps - 1, Math.max(0, step - first)));
    return true;
  }

  toggle() {
    if (this.timer) return this.stop();
    if (this.k >= this.all[this.at].episode.steps - 1) this.step(0);
    this.play.textContent = "pause";
    this.timer = setInterval(() => {
      if (this.k >= this.all[this.at].episode.steps - 1) return this.stop();
      this.step(this.k + 1);
    }, 60);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    if (this.play) this.play.textContent = "play";
  }
}
