// Draws everything once the page is there.

const data = JSON.parse(document.getElementById("data").textContent);
const place = (name) => document.getElementById(name);
document.body.append(tip);
whiskers();
learning(place("learning"), data.training);
places(place("places"), data.places);
const picker = new Picker(place("picker"), data.galleries);
near(place("near"), data.galleries, (robot, order, k) => picker.choose(robot, order, k));
latency(place("latency"), data.latency);
timeline(place("timeline"), data.timeline);
document.documentElement.dataset.drawn = "yes";
