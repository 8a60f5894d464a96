// Draws the page; the part of a run when it is first selected. A link has the form `#run=0&episode=12&step=40`.

const data = JSON.parse(document.getElementById("data").textContent);
const pickers = new Map(); // by index of the run
document.body.append(tip);
learning(document.getElementById("learning"), document.getElementById("learning-controls"), data);
whiskers(document.querySelector("main"));

/** Show the run with this index; draw it when it is first shown. */
function show(place) {
  document.querySelectorAll("div.run").forEach((box, k) => { box.hidden = k !== place; });
  const chosen = document.getElementById("run");
  if (chosen) chosen.value = String(place);
  if (pickers.has(place) || !data[place]) return;
  const run = data[place], mark = place ? `run${place}-` : "", at = (name) => document.getElementById(mark + name);
  const onshow = (order, step) => { if (document.documentElement.dataset.drawn) history.replaceState(null, "", `#run=${place}&episode=${order}&step=${step}`); };
  places(at("places"), run.places);
  const picker = new Picker(at("picker"), run.galleries, mark, onshow);
  pickers.set(place, picker);
  near(at("near"), run.galleries, (robot, order, k) => picker.choose(robot, order, k));
  latency(at("latency"), run.latency);
  timeline(at("timeline"), run.timeline);
}

/** Show the run, episode and step of the address. */
function follow() {
  const wanted = new URLSearchParams(location.hash.slice(1)), place = Number(wanted.get("run") ?? 0);
  show(data[place] ? place : 0);
  if (wanted.has("episode")) pickers.get(place)?.jump(Number(wanted.get("episode")), Number(wanted.get("step") ?? 0));
}

document.getElementById("run")?.addEventListener("change", (event) => show(Number(event.target.value)));
window.addEventListener("hashchange", follow);
follow();
document.documentElement.dataset.drawn = "yes";
