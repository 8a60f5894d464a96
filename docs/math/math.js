// Draws the formulas of a page with the copy of KaTeX 0.19.1 beside this file, so that the site needs no network.
for (const formula of document.querySelectorAll(".arithmatex")) {
  const tex = formula.textContent.trim().slice(2, -2); // without \( \) or \[ \]
  katex.render(tex, formula, { displayMode: formula.tagName === "DIV", throwOnError: false });
}
