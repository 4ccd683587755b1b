/* What the viewer has to choose from, and the parts of its page. */
const ERRORS = {
  relative: { text: "relative squared error", range: [1e-4, 1], logarithmic: true },
  signed: { text: "signed relative error", range: [0, 1], logarithmic: false },
  flip: { text: "FLIP", range: [0, 1], logarithmic: false },
  "hdr-flip": { text: "HDR-FLIP", range: [0, 1], logarithmic: false },
  estimated: { text: "estimated relative squared error", range: [1e-4, 1], logarithmic: true },
};
const HELP = [
  ["1 … 9, ← →", "flip the image of the marked pane (the one under the pointer)"],
  ["e", "flip the marked pane between the image and its errors"], ["p", "number of panes"],
  ["s", "slide against the image seen before: drag the line"], ["n", "next scene"],
  ["↑ ↓, a", "exposure by half a stop; automatic"], ["t", "tone curve"],
  ["[ ]", "range of the errors; the numbers at the colour bar can be edited"],
  ["wheel, + −, drag", "zoom and pan, all panes together"], ["0, z", "fit; one pixel to one"],
  ["shift + drag, c", "crop an inset; clear the insets"],
];
const FIRST = -1;  // a pane that shows what the first one does
const INSET = 200;  // width of an inset in pixels of the page
const MOST_MEASURED = 2 ** 18;  // pixels of an inset whose error is computed
const round = (v, digits) => Number(v.toPrecision(digits));

function made(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in element) element[name] = value; else element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}
function options(select, texts, chosen) {
  const key = JSON.stringify(texts);
  if (select.dataset.options !== key) select.replaceChildren(...Object.entries(texts).map(([value, text]) => made("option", { value, textContent: text })));
  select.dataset.options = key;
  select.value = chosen;
}

