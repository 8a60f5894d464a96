// The nearest misses, and the picker of episodes with their viewer.

const PERCEIVED = [["free", "free", "free space by the scan"], ["hits", "hit", "hits of the scan"], ["movers", "mover", "moving obstacle and its reachable set"], ["reservations", "reserved", "reserved by other robots"]];

/** Say what was decided at the point `k`, and why. */
function why(episode, k) {
  const t = episode.tubes?.[k], kind = KINDS[episode.kinds[k]].name;
  if (!t) return kind;
  const decision = [kind, t.limited].filter(Boolean).join(", ");
  const inputs = t.inputs?.map(([name, unit, proposed, executed]) => `${name} ${figure(proposed)} → ${figure(executed)} ${unit}`) ?? [`${t.proposed.join(", ")} → ${t.plan.join(", ")}`];
  const reason = (episode.kinds[k] !== "l" && t.said) || t.reason;
  return `${decision}${reason ? `: ${reason}` : ""}; proposed → executed: ${inputs.join(", ")}; margin ${t.at_least ? "> " : ""}${figure(100 * t.margin)} cm${t.trust ? `; ${t.trust}` : ""}`;
}

/** Draw the nearest misses of all robot kinds, the smallest clearance first. */
function near(target, galleries, choose) {
  const misses = Object.entries(galleries).flatMap(([robot, { near: orders, episodes }]) => orders.map((order) => ({ robot, order, episode: episodes.find((e) => e.order === order) })));
  for (const { robot, order, episode } of misses.sort((a, b) => a.episode.closest - b.episode.closest)) {
    const k = episode.closest_at;
    const reach = Math.max(0.1, 3.4 * episode.footprint, 1.3 * Math.max(0, ...(episode.tubes[k]?.boxes ?? []).map(([x, y]) => Math.hypot(x - episode.x[k], y - episode.y[k]))));
    const bounds = [episode.x[k] - reach, episode.y[k] - reach, episode.x[k] + reach, episode.y[k] + reach];
    const picture = element("div");
    picture.innerHTML = drawScene(sceneAt(episode, k), bounds, 260, `${episode.actor}, episode ${episode.episode}, step ${stepOf(episode, k)}`, k);
    picture.querySelector("svg").setAttribute("width", "100%");
    const facts = element("p", {}, element("b", {}, `${figure(100 * episode.closest)} cm`), ` ${episode.actor}, episode ${episode.episode}, step ${stepOf(episode, k)} (${episode.outcome}) `);
    facts.append(element("button", { onclick: () => choose(robot, order, k) }, "show"));
    target.append(element("div", { class: "card", "data-closest": episode.closest }, picture, facts, element("p", { class: "why" }, why(episode, k))));
  }
  if (!target.children.length) target.append(nothing("The log has no episode with a clearance."));
}

/** All episodes of a run in the order of the log, with each sketch completed by what all episodes of its robot share. */
function episodesOf(galleries) {
  return Object.entries(galleries).flatMap(([robot, { near: nearest, episodes, rest }]) => {
    const { footprint = 0, discs = [], period = null } = episodes[0] ?? {};
    const unknown = { footprint, discs, period, heading: null, tubes: {}, arena: null, half: null, floor: null, ceiling: null, goal: null, start: null, z: null };
    const all = [...episodes, ...rest.map((item) => ({ ...unknown, ...item, closest_at: item.at.indexOf(item.closest_at) }))];
    return all.sort((a, b) => a.order - b.order).map((episode) => ({ robot, episode, near: nearest.indexOf(episode.order) }));
  });
}

class Picker {
  /** `mark` is a prefix for element ids of this run; `onshow(episode, step)` is called for each step that is shown. */
  constructor(target, galleries, mark, onshow) {
    this.target = target;
    this.onshow = onshow;
    this.all = episodesOf(galleries);
    if (!this.all.length) return void target.append(nothing("The log has no episode."));
    this.select = element("select", { "aria-label": "episode", onchange: () => this.show(+this.select.value) });
    this.all.forEach(({ episode: e, near: rank }, i) => {
      const marks = [e.outcome, `${e.steps} step${e.steps === 1 ? "" : "s"}`, e.failsafes ? `${e.failsafes} failsafe` : "", rank >= 0 ? `near miss ${rank + 1}` : "", e.at ? "in short" : ""].filter(Boolean);
      this.select.append(element("option", { value: i }, `${e.actor}, episode ${e.episode}: ${marks.join(", ")}`));
    });
    target.append(element("div", { class: "bar choice" }, element("button", { onclick: () => this.move(-1), "aria-label": "previous episode" }, "‹"), this.select, element("button", { onclick: () => this.move(1), "aria-label": "next episode" }, "›")));
    const stage = element("div"), course = element("div", { class: "course" });
    this.viewer = new Viewer(stage, { id: `${mark}episode-map`, onshow: (k) => this.tell(k) });
    this.facts = element("dl", { class: "facts", id: `${mark}episode-facts` });
    course.append(this.viewer.plots);
    saves(stage, "an episode", null, () => this.viewer.drawing());
    saves(course, "an episode over time", () => this.rows(), () => course.querySelector("svg"));
    target.append(element("div", { class: "split" }, stage, element("div", {}, this.facts, course)));
    target.append(legend([...viewerLegend(), ...this.perceivedLegend()]));
    const wanted = this.all.findIndex(({ episode }) => episode.rows);
    this.show(wanted >= 0 ? wanted : Math.max(0, this.all.findIndex(({ near: rank }) => rank === 0)));
  }

  get episode() {
    return this.all[this.at].episode;
  }

  /** The steps of the episode that is shown, for a CSV. */
  rows() {
    const e = this.episode;
    return e.clearance.map((clearance, k) => ({ step: stepOf(e, k), x_m: e.x[k], y_m: e.y[k], ...(e.z ? { z_m: e.z[k] } : {}), speed_m_s: e.speed?.[k], clearance_m: clearance, decision: KINDS[e.kinds[k]].name }));
  }

  /** Legend of the perceived surroundings that at least one picture of the page shows. */
  perceivedLegend() {
    return PERCEIVED.filter(([name]) => this.all.some(({ episode }) => Object.values(episode.tubes).some((t) => t[name]))).map(([, name, words]) => [color(name), words]);
  }

  choose(robot, order, k = null) {
    this.show(this.all.findIndex((item) => item.robot === robot && item.episode.order === order), k);
    this.arrive();
  }

  /** Bring the viewer into the window. */
  arrive() {
    this.target.closest("section").scrollIntoView();
  }

  move(by) {
    this.show((this.at + by + this.all.length) % this.all.length);
  }

  show(index, k = null) {
    this.at = index;
    this.select.value = String(index);
    this.viewer.show(this.episode, k ?? this.episode.closest_at);
  }

  /** Show the facts of the episode and of its point `k`. */
  tell(k) {
    const e = this.episode, step = stepOf(e, k), all = e.at || e.x.length === e.steps;
    const facts = {
      actor: e.actor, episode: e.episode, arena: e.arena ?? "not in the log", outcome: e.outcome, steps: e.steps, reward: figure(e.reward, 4),
      interventions: `${e.interventions}, ${e.failsafes} of them failsafe`, "closest approach": e.closest === null ? "–" : `${figure(100 * e.closest)} cm${all ? ` at step ${stepOf(e, e.closest_at)}` : ""}`,
      step, position: `${[e.x[k], e.y[k], ...(e.z ? [e.z[k]] : [])].map((v) => figure(v)).join(", ")} m`, ...(e.speed ? { speed: `${figure(e.speed[k])} m/s` } : {}), clearance: `${figure(100 * e.clearance[k])} cm`, decision: why(e, k),
      ...(e.at || !all ? { "in short": `this page has ${e.at ? e.at.length : `the first ${e.x.length}`} of the steps; for all of them, run brakeline analyse with --html and --episode ${e.episode}` } : {}),
    };
    this.facts.replaceChildren(...Object.entries(facts).flatMap(([name, value]) => [element("dt", {}, name), element("dd", { "data-fact": name }, String(value))]));
    this.onshow(e, step);
  }

  /** Follow a key; return false if it means nothing here. */
  key(event) {
    if (!this.viewer) return false;
    const focused = this.viewer.stage.contains(document.activeElement);
    const by = { n: 1, p: -1, ...(focused ? { ArrowDown: 1, ArrowUp: -1 } : {}) }[event.key];
    if (by) this.move(by);
    return Boolean(by) || this.viewer.key(event);
  }

  /** Show the first episode that `is(episode)`, at a step; return false if the page does not have it. */
  jump(is, step) {
    const place = this.all.findIndex(({ episode }) => is(episode));
    if (place < 0) return false;
    this.show(place, step === null ? null : pointOf(this.all[place].episode, step));
    return true;
  }

  /** Show the episode that ended next to a step of all actors of a robot kind. */
  openAt(robot, step) {
    const own = this.all.filter((item) => item.robot === robot);
    if (!own.length) return;
    const after = own.filter(({ episode }) => episode.until >= step), { episode } = after.length ? after.reduce((a, b) => (b.episode.until < a.episode.until ? b : a)) : own.at(-1);
    this.choose(robot, episode.order);
  }
}
