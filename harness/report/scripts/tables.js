// Tables that are sorted by a click on a head, and copied as CSV.

// A cell that begins as a formula would is no formula in whoever's spreadsheet it lands.
const quoted = (text) => `"${text.replace(/^(?=[=+\-@\t\r])(?![-+]?[\d.]+$)/, "'").replaceAll('"', '""')}"`;

const csvOf = (rows) =>
  rows.map((row) => `${row.map((cell) => quoted(String(cell ?? ""))).join(",")}\r\n`).join("");

const rowsOf = (table) =>
  [...table.rows].map((row) => [...row.cells].map((cell) => cell.innerText.trim().replace(/\s*\n\s*/g, "; ")));

async function copy(button, text) {
  const said = button.textContent;
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "copied";
  } catch {
    const area = h("textarea", { class: "off", "aria-hidden": "true" });
    area.value = text;
    document.body.append(area);
    area.select();
    button.textContent = document.execCommand("copy") ? "copied" : "not copied";
    area.remove();
  }
  setTimeout(() => { button.textContent = said; }, 1500);
}

const copyButton = (rows) => small("Copy as CSV", (event) => copy(event.target, csvOf(rows())));

function copied(table) {
  (table.closest(".scroll") ?? table).after(copyButton(() => rowsOf(table)));
}

const valueOf = (row, column) => {
  const cell = row.cells[column];
  const text = cell.dataset.value ?? cell.innerText;
  const value = parseFloat(text);
  return Number.isNaN(value) ? text : value;
};

function sort(table, column, descending) {
  const rows = [...table.tBodies[0].rows].map((row) => [valueOf(row, column), row]);
  const order = ([a], [b]) => {
    if (a === "" || b === "") return (a === "") - (b === ""); // what is not known comes last
    const sign = typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b));
    return descending ? -sign : sign;
  };
  table.tBodies[0].append(...rows.sort(order).map(([, row]) => row));
  [...table.tHead.rows[0].cells].forEach((head, n) =>
    head.setAttribute("aria-sort", n !== column ? "none" : descending ? "descending" : "ascending"));
}

function sortable(table) {
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = h("button", {
      type: "button",
      // Figures are read from the largest, names from the first.
      onclick: () => sort(table, column, head.ariaSort === "none" || head.ariaSort == null
        ? typeof valueOf(table.tBodies[0].rows[0], column) === "number"
        : head.ariaSort === "ascending"),
    }, head.textContent);
    head.replaceChildren(button);
    head.setAttribute("aria-sort", "none");
  });
}

// A table of elements or text with a head, the first cell of a row its name.
const table = (name, heads, rows) => {
  const made = h("table", { "data-csv": name },
    h("thead", {}, h("tr", {}, heads.map((head) => h("th", { scope: "col" }, head)))),
    h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, n) =>
      n === 0 ? h("th", { scope: "row" }, cell) : h("td", {}, cell))))));
  const box = h("div", {}, h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": name }, made));
  copied(made);
  return box;
};
