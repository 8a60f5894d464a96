// Save figures as SVG and their data as CSV.

/** The styles of a saved figure, on white. */
const LOOK = `svg{font:11px "DejaVu Sans",Helvetica,Arial,sans-serif;background:#fff}text{fill:#3c4856}.title{fill:#1b2430;font-weight:600;font-size:12.5px}
.grid{stroke:#e6eaef}.axis{stroke:#aab4c0}.ink{stroke:#1b2430}.solid{fill:#1b2430;stroke:none}.paper{fill:#fcfdfe}`;

function save(name, kind, text) {
  const link = element("a", { href: URL.createObjectURL(new Blob([text], { type: kind })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Return the text of an SVG file. */
function standalone(svg) {
  const text = new XMLSerializer().serializeToString(svg);
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

/** Add buttons that save the drawing in `box` and its data `rows()`. */
function saves(box, name, rows) {
  const buttons = element("div", { class: "saves" });
  buttons.append(element("button", { onclick: () => save(`${fileName(name)}.svg`, "image/svg+xml", standalone(box.querySelector("svg"))), "aria-label": `save “${name}” as SVG` }, "SVG"));
  if (rows) buttons.append(element("button", { onclick: () => save(`${fileName(name)}.csv`, "text/csv", csv(rows())), "aria-label": `save the data of “${name}” as CSV` }, "CSV"));
  box.append(buttons);
}
