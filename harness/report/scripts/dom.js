// Elements out of text that is never read as markup, and what lies compressed in the page.

// What shows nothing, or turns the line around, is spelt out: as `visible` does where the page is written.
const HIDDEN = /(?![\n\t ])[\p{C}\p{Z}]/gu;
const visible = (value) =>
  String(value).replace(HIDDEN, (c) => `⟨U+${c.codePointAt(0).toString(16).toUpperCase().padStart(4, "0")}⟩`);

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, value);
  }
  for (const child of children.flat(Infinity)) {
    if (child instanceof Node) element.append(child);
    else if (child != null && child !== false) element.append(visible(child));
  }
  return element;
}

const h = (tag, attributes = {}, ...children) => fill(document.createElement(tag), attributes, children);
const svg = (tag, attributes = {}, ...children) =>
  fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);

const option = (value, text, selected) => h("option", { value, selected: value === selected }, text);
const choice = (label, name, options, selected, onchange) =>
  h("label", {}, label, " ",
    h("select", { name, onchange }, options.map(([value, text]) => option(value, text, selected))));
const small = (text, onclick) => h("button", { type: "button", class: "small", onclick }, text);

async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

const blocks = new Map();
function block(n) {
  if (!blocks.has(n)) blocks.set(n, unpacked(`block-${n}`).then(JSON.parse));
  return blocks.get(n);
}

// What a server put into the page that it opened: all there is of some decisions, by scene.
const opened = document.getElementById("opened") ? unpacked("opened").then(JSON.parse) : {};

// The one way to write a number: with so many decimals and its unit; a dash where it is not known.
const number = (value, digits, unit = "") =>
  value == null ? "–" : value.toFixed(digits) + (unit && ` ${unit}`);

function download(name, content) {
  const url = URL.createObjectURL(content);
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}
