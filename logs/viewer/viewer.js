// The viewer of an episode, in the report and on the live page: in space, from above and from the side, over its time.

const VIEWS = { space: "3-D", above: "from above", side: "from the side" };
const KEYS = [
  ["space", "play or pause, while the picture is in the window"],
  ["← →", "step back or ahead"],
  ["Home End", "the first or the last step, after a click on the picture"],
  ["p n", "previous or next episode"],
  ["v", "next view: 3-D, from above, from the side"],
  ["a d w s", "turn and tilt the camera"],
  ["+ −", "come closer or go away"],
  ["f", "follow the robot"],
  ["0", "look at the whole arena again"],
  ["?", "show or hide these keys"],
];
const FRAME = 60; // ms between two steps of a play

/** Legend of what a viewer draws. */
const viewerLegend = () => [
  ...["l", "d", "a", "e"].map((k) => [KINDS[k].color, KINDS[k].name]),
  ...[["tube", "tube and plan"], ["proposed", "→ proposed"], ["executed", "→ executed"], ["halfspace", "edge of the half-space that blocks the proposal"], ["goal", "goal"], ["obstacle", "obstacles"]].map(([name, words]) => [color(name), words]),
];

class Viewer {
  /** `onshow(k)` is called for each point of the episode that is shown. `id`: of the picture. */
  constructor(target, { id = null, onshow = () => {} } = {}) {
    this.onshow = onshow;
    this.space = null;
    this.view = renderer() ? "space" : "above";
    const views = Object.entries(VIEWS).map(([view, words]) => element("button", { "data-view": view, onclick: () => this.look(view) }, words));
    this.views = element("div", { class: "bar views", role: "group", "aria-label": "view" }, ...views);
    this.followed = element("button", { class: "follow", onclick: () => this.follow() }, "follow the robot");
    this.views.append(this.followed, element("button", { class: "home", onclick: () => this.home() }, "whole arena"));
    const words = "The episode. Left and right arrow: step. Space: play. Question mark: all keys.";
    this.stage = element("div", { id, class: "episode-map stage", tabindex: 0, "aria-label": words });
    this.note = element("p", { class: "small nowebgl" }, renderer() ? "" : "This browser has no WebGL, so there is no 3-D view: you see the episode from above. To see it in 3-D, turn on hardware acceleration, or use another browser.");
    this.slider = element("input", { type: "range", min: 0, "aria-label": "step", oninput: () => { this.stop(); this.step(+this.slider.value); } });
    this.playing = element("button", { class: "play", onclick: () => this.toggle() }, "play");
    this.clock = element("span", { class: "clock" });
    this.plots = element("div", { class: "plots", onclick: (event) => { const k = pointAtClick(this.episode, event); if (k !== null) this.step(k); } });
    target.append(this.views, this.note, this.stage, element("div", { class: "bar" }, this.playing, this.slider, this.clock));
    this.timer = null;
  }

  /** Show an episode at its point `k`. */
  show(episode, k) {
    this.stop();
    this.episode = episode;
    this.slider.max = episode.x.length - 1;
    if (this.view === "side" && !episode.z) this.view = renderer() ? "space" : "above";
    this.step(k);
  }

  /** Show a longer version of an episode that goes on: at its end, unless somebody looks at an earlier step. */
  refresh(episode) {
    const same = this.episode?.actor === episode.actor && this.episode?.episode === episode.episode;
    const earlier = same && this.k < this.episode.x.length - 1 ? stepOf(this.episode, this.k) : null;
    this.episode = episode;
    this.slider.max = episode.x.length - 1;
    this.step(earlier === null ? episode.x.length - 1 : pointOf(episode, earlier));
  }

  step(k) {
    this.k = Math.min(this.episode.x.length - 1, Math.max(0, k));
    this.slider.value = this.k;
    this.draw();
    this.onshow(this.k);
  }

  draw() {
    const { episode, k } = this, period = episode.period;
    for (const button of this.views.querySelectorAll("[data-view]")) {
      const { view } = button.dataset;
      button.setAttribute("aria-pressed", String(view === this.view));
      button.hidden = view === "side" && !episode.z;
      button.disabled = view === "space" && !renderer();
    }
    for (const button of this.views.querySelectorAll(".follow, .home")) button.hidden = this.view !== "space";
    const scene = sceneAt(episode, k);
    if (this.view === "space") this.drawSpace(scene);
    else this.stage.innerHTML = this.drawing();
    this.clock.textContent = `step ${stepOf(episode, k)}${period ? ` · ${figure(stepOf(episode, k) * period, 4)} s` : ""}`;
    this.plots.innerHTML = "";
    for (const [name, plot] of plotsOf(episode, k)) {
      const figure = element("div", { "data-plot": name });
      figure.innerHTML = plot;
      this.plots.append(figure);
    }
  }

  drawSpace(scene) {
    if (!this.space) {
      this.canvas = element("canvas", { tabindex: 0, "aria-label": "The episode in 3-D. Drag to turn it." });
      this.space = new Space(this.canvas);
    }
    if (this.canvas.parentNode !== this.stage) this.stage.replaceChildren(this.canvas);
    this.space.show(scene, this.k, `${scene.robot} ${scene.actor} ${scene.episode} ${scene.order ?? ""}`);
    this.followed.setAttribute("aria-pressed", String(Boolean(this.space.following)));
  }

  /** The episode as SVG: from the side if that is shown, else from above. */
  drawing() {
    const { episode, k } = this, axes = this.view === "side" ? ASIDE : ABOVE, scene = sceneAt(episode, k);
    const title = `${episode.actor}, episode ${episode.episode}, step ${stepOf(episode, k)}, ${axes === ASIDE ? VIEWS.side : VIEWS.above}`;
    return drawScene(scene, sceneBounds(scene, axes), 600, title, k, axes);
  }

  look(view) {
    if (view === "space" && !renderer()) return;
    this.view = view;
    this.draw();
  }

  follow() {
    if (this.view !== "space") return;
    if (this.space.following) this.space.home();
    else this.space.follow();
    this.followed.setAttribute("aria-pressed", String(this.space.following));
  }

  home() {
    this.space?.home();
    this.followed.setAttribute("aria-pressed", "false");
  }

  toggle() {
    if (this.timer) return this.stop();
    if (this.k >= this.episode.x.length - 1) this.step(0);
    this.playing.textContent = "pause";
    this.timer = setInterval(() => {
      if (this.k >= this.episode.x.length - 1) return this.stop();
      this.step(this.k + 1);
    }, FRAME);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.playing.textContent = "play";
  }

  /** Follow a key; return false if it means nothing here. */
  key(event) {
    const focused = this.stage.contains(document.activeElement), available = Object.keys(VIEWS).filter((view) => (view !== "space" || renderer()) && (view !== "side" || this.episode.z));
    const { top, bottom } = this.stage.getBoundingClientRect(), seen = bottom > 0 && top < innerHeight;
    const turn = (...by) => () => this.view === "space" && this.space.orbit(...by);
    const moves = {
      ArrowRight: () => { this.stop(); this.step(this.k + 1); },
      ArrowLeft: () => { this.stop(); this.step(this.k - 1); },
      ...(focused ? { Home: () => { this.stop(); this.step(0); }, End: () => { this.stop(); this.step(this.episode.x.length - 1); } } : {}),
      ...(seen ? { " ": () => this.toggle() } : {}), // else the space bar scrolls the page
      v: () => this.look(available[(available.indexOf(this.view) + 1) % available.length]),
      a: turn(-0.15, 0), d: turn(0.15, 0), w: turn(0, 0.1), s: turn(0, -0.1), "+": turn(0, 0, 0.85), "=": turn(0, 0, 0.85), "-": turn(0, 0, 1.18),
      f: () => this.follow(),
      0: () => this.home(),
    };
    if (!moves[event.key]) return false;
    moves[event.key]();
    return true;
  }
}

/** Listen to keys on the whole page, and show them for a question mark; `act(event)` returns whether it used the key. */
function listenToKeys(act) {
  const rows = KEYS.flatMap(([key, words]) => [element("dt", {}, key), element("dd", {}, words)]);
  const close = element("button", { onclick: () => help.close() }, "close");
  const help = element("dialog", { id: "keys", "aria-label": "keys" }, element("h2", {}, "Keys"), element("dl", { class: "facts" }, ...rows), close);
  const toggle = () => (help.open ? help.close() : help.showModal());
  document.body.append(help);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const typing = event.target.closest?.("select, textarea, input:not([type=range]):not([type=checkbox])");
    const pressing = event.key === " " && event.target.closest?.("button, a, summary, input[type=checkbox]");
    if (typing || pressing) return;
    if (event.key === "?") toggle();
    else if (help.open || !act(event)) return;
    event.preventDefault();
  });
  return toggle;
}
