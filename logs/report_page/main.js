// Draws the page; the part of a run when it is first selected.
// A link to an episode is `#episode-12`, also with `&step=40` or `&time=8.2` (s), `&actor=actor-0` and `&run=1`.

const data = JSON.parse(document.getElementById("data").textContent);
const groups = JSON.parse(document.getElementById("group-data").textContent);
const pickers = new Map(); // by index of the run
let shown = 0; // index of the run
let remembered = 0; // timer of the address
document.body.append(tip);
if (groups.length) profiles(document.getElementById("profiles"), groups);
document.querySelectorAll(".swatch").forEach((mark) => { mark.style.background = groups[Number(mark.dataset.color)].color; });
learning(document.getElementById("learning"), document.getElementById("learning-controls"), data, groups, (run, robot, step) => {
  show(data.indexOf(run));
  pickers.get(shown).openAt(robot, step);
});
whiskers(document.querySelector("main"));

/** Show the run with this index; draw it when it is first shown. */
function show(place) {
  shown = place;
  document.querySelectorAll("div.run").forEach((box, k) => { box.hidden = k !== place; });
  const chosen = document.getElementById("run");
  if (chosen) chosen.value = String(place);
  contents();
  if (pickers.has(place) || !data[place]) return;
  const run = data[place], mark = place ? `run${place}-` : "", at = (name) => document.getElementById(mark + name);
  places(at("places"), run.places);
  const picker = new Picker(at("picker"), run.galleries, mark, (episode, step) => remember(place, episode, step));
  pickers.set(place, picker);
  near(at("near"), run.galleries, (robot, order, k) => picker.choose(robot, order, k));
  latency(at("latency"), run.latency);
  timeline(at("timeline"), run.timeline);
}

/** Put the step that is shown into the address, once it stays: browsers limit how often a page may change its address. */
function remember(place, episode, step) {
  if (!document.documentElement.dataset.drawn) return;
  const words = new URLSearchParams({ actor: episode.actor, step, ...(data.length > 1 ? { run: place } : {}) });
  const from = location.hash; // not over an address that somebody enters meanwhile
  const write = () => location.hash === from && history.replaceState(null, "", `#episode-${episode.episode}&${words}`);
  clearTimeout(remembered);
  remembered = setTimeout(write, 250);
}

/** Show the run, the episode and the step of the address. */
function follow() {
  const words = location.hash.slice(1).replace(/^episode-(\d+)/, "episode=$1"), wanted = new URLSearchParams(words);
  const place = Number(wanted.get("run") ?? (document.documentElement.dataset.drawn ? shown : 0));
  show(data[place] ? place : 0);
  if (!wanted.has("episode")) return;
  const picker = pickers.get(shown), number = Number(wanted.get("episode")), actor = wanted.get("actor");
  const is = (episode) => episode.episode === number && (actor === null || episode.actor === actor);
  const time = (episode) => Math.round(Number(wanted.get("time")) / (episode.period ?? 1));
  const found = picker?.all.find(({ episode }) => is(episode))?.episode;
  if (!found) return tell(`This page does not have episode ${number}${actor ? ` of ${actor}` : ""}.`);
  picker.jump(is, wanted.has("step") ? Number(wanted.get("step")) : wanted.has("time") ? time(found) : null);
  picker.arrive();
}

/** Say something at the top of the page. */
function tell(words) {
  document.getElementById("message").textContent = words;
}

/** List the sections that are shown. */
function contents() {
  const sections = [...document.querySelectorAll("main section[id]")].filter((section) => !section.closest("[hidden]"));
  const links = sections.map((section) => element("a", { href: `#${section.id}` }, section.querySelector("h2")?.textContent ?? section.getAttribute("aria-label")));
  document.getElementById("contents").replaceChildren(...links);
}

document.getElementById("run")?.addEventListener("change", (event) => show(Number(event.target.value)));
window.addEventListener("hashchange", follow);
const keys = listenToKeys((event) => Boolean(pickers.get(shown)?.key(event)));
document.getElementById("keys-button").addEventListener("click", keys);
follow();
document.documentElement.dataset.drawn = "yes";
