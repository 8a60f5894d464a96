// Small tools for drawing: elements, numbers, scales and axes.

/** Return a color of colors.css for a drawing or a style. */
const color = (name) => `var(--${name})`;

const KINDS = {
  l: { name: "allowed", color: color("allowed") },
  d: { name: "adjusted", color: color("adjusted") },
  a: { name: "failsafe", color: color("failsafe") },
  e: { name: "recovering", color: color("recovering") },
  n: { name: "no filter", color: color("unfiltered") },
};
const INTERVENTIONS = "dae"; // letters of KINDS

/** Markup made by `tag`. Every other value in a drawing is text and is escaped. */
class Markup extends String {}

/** Escape a value for markup. No value gets into a drawing in another way. */
function escaped(value) {
  if (value instanceof Markup) return value;
  if (Array.isArray(value)) return value.map(escaped).join("");
  return String(value).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
}

/** Return an SVG element without its attributes that are null or undefined. `content`: texts, elements, or arrays. */
function tag(name, attributes, content = "") {
  const list = Object.entries(attributes)
    .filter(([, value]) => value !== null && value !== undefined)
    .map(([key, value]) => ` ${key}="${typeof value === "number" ? +value.toFixed(3) : escaped(String(value))}"`);
  return new Markup(`<${name}${list.join("")}>${escaped(content)}</${name}>`);
}

function label(x, y, text, attributes = {}) {
  return tag("text", { x, y, ...attributes }, String(text));
}

function drawing(width, height, what, content, attributes = {}) {
  const box = { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": what };
  return tag("svg", { xmlns: "http://www.w3.org/2000/svg", ...box, ...attributes }, content);
}

function element(name, attributes = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "style") node.style.cssText = value; // the page's policy forbids the attribute
    else if (value !== null) node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

function figure(value, digits = 3) {
  if (value === null || value === undefined) return "–";
  if (Math.abs(value) < 1e-12) return "0";
  if (Math.abs(value) >= 1000) return Math.round(value).toLocaleString("en").replaceAll(",", "\u202f");
  return String(+value.toPrecision(digits));
}

function percent(share) {
  if (share === null || share === undefined) return "–";
  const value = 100 * share;
  return `${value >= 1 || value === 0 ? value.toFixed(1) : value.toPrecision(2)} %`;
}

/** Format a share for an axis, in percent. */
function percents(share) {
  return `${+(100 * share).toPrecision(3)} %`;
}

/** Return about `count` round values between low and high. */
function ticks(low, high, count = 5) {
  if (!(high > low)) return [low];
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) found.push(+(k * step).toPrecision(12));
  return found;
}

function scale(from, to, begin, end) {
  const factor = to > from ? (end - begin) / (to - from) : 0;
  return (value) => begin + (value - from) * factor;
}

/** Return grid lines and labels of both axes. `frame`: left, right, top, bottom of the plot. */
function axes(frame, x, y, xs, ys, form = {}) {
  const { left, right, top, bottom } = frame;
  const parts = [];
  for (const value of ys) {
    parts.push(tag("line", { x1: left, x2: right, y1: y(value), y2: y(value), class: "grid" }));
    parts.push(label(left - 6, y(value) + 4, (form.y || figure)(value), { "text-anchor": "end" }));
  }
  for (const value of xs) {
    parts.push(tag("line", { x1: x(value), x2: x(value), y1: bottom, y2: bottom + 4, class: "axis" }));
    parts.push(label(x(value), bottom + 16, (form.x || figure)(value), { "text-anchor": "middle" }));
  }
  parts.push(tag("line", { x1: left, x2: right, y1: bottom, y2: bottom, class: "axis" }));
  return parts;
}

function legend(entries) {
  const box = element("div", { class: "legend" });
  for (const [color, text] of entries) {
    const item = element("span", {}, element("i", { style: `background:${color}` }), text);
    box.append(item);
  }
  return box;
}

function nothing(text) {
  return element("p", { class: "none" }, text);
}

const tip = element("div", { id: "tip" });

/** Return the place of the pointer, in units of a drawing. */
function pointIn(svg, event) {
  const bounds = svg.getBoundingClientRect(), per = svg.viewBox.baseVal.width / bounds.width;
  return [(event.clientX - bounds.left) * per, (event.clientY - bounds.top) * per];
}

/** Show `text(x, y)` beside the pointer while it is over `target`; x and y in units of the drawing; null hides it. */
function hovers(target, text) {
  const svg = target.querySelector("svg");
  const hide = () => { tip.style.display = "none"; };
  target.addEventListener("pointermove", (event) => {
    const words = text(...pointIn(svg, event));
    if (words === null) return hide();
    tip.textContent = words;
    tip.style.display = "block";
    const left = Math.min(event.clientX + 14, innerWidth - tip.offsetWidth - 8);
    tip.style.left = `${left}px`;
    tip.style.top = `${Math.max(8, event.clientY - tip.offsetHeight - 10)}px`;
  });
  target.addEventListener("pointerleave", hide);
}
