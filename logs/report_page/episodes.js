// The nearest misses, and the picker of episodes.

function why(episode, k) {
  const t = episode.tubes[k];
  if (!t) return KINDS[episode.kinds[k]].name;
  const inputs = t.inputs?.map(([name, unit, proposed, executed]) => `${name} ${figure(proposed)} → ${figure(executed)} ${unit}`) ?? [`${t.proposed.join(", ")} → ${t.plan.join(", ")}`];
  const said = (episode.kinds[k] !== "l" && t.said) || t.reason;
  return `${KINDS[episode.kinds[k]].name}${said ? `: ${said}` : ""}; proposed → executed: ${inputs.join(", ")}; margin ${t.at_least ? "> " : ""}${figure(100 * t.margin)} cm${t.trust ? `; ${t.trust}` : ""}`;
}

/** The nearest misses of all robot kinds, worst first. */
function near(target, galleries, choose) {
  const found = Object.entries(galleries).flatMap(([robot, { near: orders, episodes }]) => orders.map((order) => ({ robot, order, episode: episodes.find((e) => e.order === order) })));
  for (const { robot, order, episode } of found.sort((a, b) => a.episode.closest - b.episode.closest)) {
    const k = episode.closest_at;
    const reach = Math.max(0.1, 3.4 * episode.footprint, 1.3 * Math.max(0, ...(episode.tubes[k]?.boxes ?? []).map(([x, y]) => Math.hypot(x - episode.x[k], y - episode.y[k]))));
    const box = [episode.x[k] - reach, episode.y[k] - reach, episode.x[k] + reach, episode.y[k] + reach];
    const picture = element("div");
    picture.innerHTML = arena(episode, k, 260, box);
    picture.querySelector("svg").setAttribute("width", "100%");
    const facts = element("p", {}, element("b", {}, `${figure(100 * episode.closest)} cm`), ` ${episode.actor}, episode ${episode.episode}, step ${episode.first + k} (${episode.outcome}) `);
    facts.append(element("button", { onclick: () => choose(robot, order, k) }, "show"));
    target.append(element("div", { class: "card", "data-closest": episode.closest }, picture, facts, element("p", { class: "why" }, why(episode, k))));
  }
  if (!target.children.length) target.append(nothing("No episode was recorded with its clearance."));
}

/** Clearance over the steps of an episode, coloured by decision. */
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
  /** `mark` goes before names that the page has once; `said(order, step)` hears what is shown. */
  constructor(target, galleries, mark, said) {
    this.target = target;
    this.said = said;
    this.all = Object.entries(galleries).flatMap(([robot, { near: nearest, episodes }]) => episodes.map((episode) => ({ robot, episode, near: nearest.indexOf(episode.order) })));
    if (!this.all.length) return void target.append(nothing("No episode was recorded."));
    this.select = element("select", { "aria-label": "episode", onchange: () => this.show(+this.select.value) });
    this.all.forEach(({ episode: e, near: rank }, i) => {
      const marks = [e.outcome, `${e.steps} steps`, e.failsafes ? `${e.failsafes} failsafe` : "", rank >= 0 ? `near miss ${rank + 1}` : ""].filter(Boolean);
      this.select.append(element("option", { value: i }, `${e.actor}, episode ${e.episode}: ${marks.join(", ")}`));
    });
    const move = (by) => this.show((this.at + by + this.all.length) % this.all.length);
    this.slider = element("input", { type: "range", min: 0, "aria-label": "step", oninput: () => this.step(+this.slider.value) });
    this.play = element("button", { onclick: () => this.toggle() }, "play");
    target.append(element("div", { class: "bar" }, element("button", { onclick: () => move(-1), "aria-label": "previous episode" }, "‹"), this.select, element("button", { onclick: () => move(1), "aria-label": "next episode" }, "›"), this.play, this.slider));
    this.map = element("div", { id: `${mark}episode-map`, class: "episode-map", tabindex: 0, "aria-label": "an episode: arrow keys step through it, space plays it", onkeydown: (event) => this.key(event) });
    this.facts = element("dl", { class: "facts", id: `${mark}episode-facts` });
    this.strip = element("div");
    const seen = element("div", {}, this.map), course = element("div", { class: "course" }, this.strip);
    saves(seen, "an episode from above");
    saves(course, "clearance over the episode", () => this.rows());
    target.append(element("div", { class: "split" }, seen, element("div", {}, this.facts, course)));
    target.append(legend([...["l", "d", "a", "e"].map((k) => [KINDS[k].color, KINDS[k].name]), ["#7a4fc0", "tube, and the plan in it"], [ARROWS[0], "→ proposed"], [ARROWS[1], "→ executed"], [EDGE, "what the proposal would have crossed"], ["#1d7f4e", "goal"], ["#c9d1da", "obstacles"], ...this.told()]));
    const wanted = this.all.findIndex(({ episode }) => episode.rows);
    this.show(wanted >= 0 ? wanted : Math.max(0, this.all.findIndex(({ near: rank }) => rank === 0)));
  }

  /** The steps of the episode that is shown, for a CSV. */
  rows() {
    const { episode: e } = this.all[this.at];
    return e.clearance.map((clearance, k) => ({ step: e.first + k, x_m: e.x[k], y_m: e.y[k], speed_m_s: e.speed[k], clearance_m: clearance, decision: KINDS[e.kinds[k]].name }));
  }

  /** Of what the filter was told, the parts that any picture here shows. */
  told() {
    const parts = [["free", FREE, "what the scan showed to be free"], ["hits", HIT, "where beams ended"], ["movers", MOVER, "what moves, and where it may come to"], ["promises", PROMISE, "where other robots promise to be"]];
    return parts.filter(([name]) => this.all.some(({ episode }) => Object.values(episode.tubes).some((t) => t[name]))).map(([, color, said]) => [color, said]);
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
    this.map.innerHTML = arena(e, k, 600);
    this.strip.innerHTML = strip(e, k);
    const facts = {
      actor: e.actor, episode: e.episode, arena: e.arena ?? "its beginning is in no file", outcome: e.outcome, steps: e.steps, reward: figure(e.reward, 4),
      interventions: `${e.interventions}, of these failsafe ${e.failsafes}`, "closest approach": e.closest === null ? "–" : `${figure(100 * e.closest)} cm at step ${e.first + e.closest_at}`,
      step: e.first + k, position: `${figure(e.x[k])}, ${figure(e.y[k])} m`, speed: `${figure(e.speed[k])} m/s`, clearance: `${figure(100 * e.clearance[k])} cm`, decision: why(e, k),
    };
    this.said(e.order, e.first + k);
    this.facts.replaceChildren(...Object.entries(facts).flatMap(([name, value]) => [element("dt", {}, name), element("dd", { "data-fact": name }, String(value))]));
  }

  /** Steps to the sides, episodes up and down, space plays. */
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

  /** The episode of that number in the log's order, at a step; false: it is not in the page. */
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
