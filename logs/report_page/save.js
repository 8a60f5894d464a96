// Save figures as SVG and their data as CSV.

/** The styles of a saved figure, on white: with the light colors, which are the first rule of the page. */
const LOOK = `svg{${document.styleSheets[0]?.cssRules[0]?.style.cssText ?? ""}font:11px "DejaVu Sans",Helvetica,Arial,sans-serif;background:#fff}text{fill:var(--soft)}.title{fill:var(--ink);font-weight:600;font-size:12.5px}
.grid{stroke:var(--grid)}.axis{stroke:var(--axis)}.ink{stroke:var(--ink)}.solid{fill:var(--ink);stroke:none}.paper{fill:var(--field)}`;

function save(name, kind, text) {
  const link = element("a", { href: URL.createObjectURL(new Blob([text], { type: kind })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Return the text of an SVG file. `svg`: an element or its markup. */
function standalone(svg) {
  const text = svg instanceof Element ? new XMLSerializer().serializeToString(svg) : String(svg);
  return `<?xml version="1.0" encoding="UTF-8"?>\n${text.replace(/>/, `><style>${LOOK}</style>`)}`;
}

/** Encode rows of named values; the first row gives the columns. */
function csv(rows) {
  const columns = Object.keys(rows[0] ?? {});
  const cell = (value) => {
    const text = String(value ?? "");
    return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return [columns, ...rows.map((row) => columns.map((name) => row[name]))].map((row) => row.map(cell).join(",")).join("\n") + "\n";
}

const fileName = (words) => words.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "");

/** Add buttons that save a drawing `svg()`, by default the one in `box`, and its data `rows()`. */
function saves(box, name, rows, svg = () => box.querySelector("svg")) {
  const buttons = element("div", { class: "saves" });
  buttons.append(element("button", { onclick: () => save(`${fileName(name)}.svg`, "image/svg+xml", standalone(svg())), "aria-label": `save “${name}” as SVG` }, "SVG"));
  if (rows) buttons.append(element("button", { onclick: () => save(`${fileName(name)}.csv`, "text/csv", csv(rows())), "aria-label": `save the data of “${name}” as CSV` }, "CSV"));
  box.append(buttons);
}
