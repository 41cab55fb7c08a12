"use strict";
// Keeps the list up to date while a run goes on: texts that say how far it is, and all rows once one ends.
(() => {
const LEAST_MS = 2000, SHARE = 10;  // it waits ten times as long as an answer takes: a folder may be large
const table = document.querySelector(".runs"), status = document.getElementById("updates");

async function look() {
  const began = performance.now();
  let now;
  try {
    now = await (await fetch("/progress")).json();
    if (now.listed !== table.dataset.listed) await renew();
  } catch {
    status.textContent = "This list is no longer kept up to date: harness view does not answer.";
    return;
  }
  for (const cell of table.querySelectorAll("[data-run]")) {
    const text = now.unfinished[cell.dataset.run];
    if (text !== undefined && text !== cell.textContent) cell.textContent = text;
  }
  if (now.going) setTimeout(look, Math.max(LEAST_MS, SHARE * (performance.now() - began)));
  else status.textContent = "No run is going on; load the page again after you begin one.";
}

async function renew() {
  const page = new DOMParser().parseFromString(await (await fetch(location.href)).text(), "text/html");
  const rows = page.querySelector(".runs");
  if (!rows) return;
  const picked = new Set([...table.querySelectorAll("input:checked")].map((box) => box.value));
  for (const box of rows.querySelectorAll("input")) box.checked = picked.has(box.value);
  const at = document.activeElement, name = at.getAttribute("value") ?? at.getAttribute("href");
  const within = table.tBodies[0].contains(at);
  table.tBodies[0].replaceWith(rows.tBodies[0]);
  document.querySelector(".count").replaceWith(page.querySelector(".count"));
  table.dataset.listed = rows.dataset.listed;
  const same = (each) => name === (each.getAttribute("value") ?? each.getAttribute("href"));
  if (within) [...table.querySelectorAll("tbody :is(input, a)")].find(same)?.focus();
}

setTimeout(look, LEAST_MS);
})();
