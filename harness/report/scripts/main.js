// What the address says is shown: the report, or one decision.

const report = document.getElementById("report"), single = document.getElementById("decision");
let about, index, list, strips, replay, page, drawn;

function themes() {
  const button = document.getElementById("theme"), root = document.documentElement;
  const system = matchMedia("(prefers-color-scheme: dark)");
  const dark = () => (root.dataset.theme ? root.dataset.theme === "dark" : system.matches);
  const say = () => { button.textContent = dark() ? "Light" : "Dark"; };
  button.addEventListener("click", () => { root.dataset.theme = dark() ? "light" : "dark"; say(); });
  system.addEventListener("change", say);
  button.hidden = false;
  say();
}

// What is folded is not printed, and not found by a search of the browser.
function unfolding() {
  const button = document.getElementById("unfold"), folds = report.querySelectorAll("details");
  button.addEventListener("click", () => folds.forEach((fold) => { fold.open = true; }));
  button.hidden = false;
}

// A section that the address names is opened.
function unfold(name) {
  const fold = document.getElementById(name)?.querySelector(":scope > .fold");
  if (fold) fold.open = true;
}

async function route() {
  const params = new URLSearchParams(location.hash.slice(1)), opened = params.has("scene");
  report.hidden = opened;
  single.hidden = !opened;
  if (opened) {
    delete single.dataset.drawn;
    await page.draw(params);
    scrollTo(0, 0);
    single.querySelector("h1")?.focus({ preventScroll: true });
    return;
  }
  list.show();
  strips.show();
  await replay.show();
  unfold(params.has("decisions") ? "decisions" : location.hash.slice(1));
  drawn ??= drawAll(about.charts);
  if (params.has("decisions")) {
    const coming = document.getElementById("decisions").getBoundingClientRect().top;
    if (coming > innerHeight || coming < 0) document.getElementById("decisions").scrollIntoView();
  } else document.getElementById(location.hash.slice(1))?.scrollIntoView();
}

addEventListener("keydown", (event) => {
  const typing = event.target.closest("input, select, textarea, pre, [tabindex='0']");
  if (single.hidden || typing || event.altKey || event.ctrlKey || event.metaKey) return;
  [...single.querySelectorAll("[data-key]")].find((link) => link.dataset.key === event.key)?.click();
});

(async () => {
  themes();
  unfolding();
  document.querySelectorAll("table[data-csv]").forEach(copied);
  document.querySelectorAll("table.sortable").forEach(sortable);
  [about, index] = (await Promise.all([unpacked("about"), unpacked("index")])).map(JSON.parse);
  list = new List(index, about, document.getElementById("list"));
  strips = new Episodes(list, about.actions, document.getElementById("strips"));
  replay = new Replay(strips, about, document.getElementById("replay"));
  page = new DecisionPage(single, list, index, about);
  document.querySelectorAll("a[data-scene]").forEach((a) => { a.href = `#${new URLSearchParams(a.dataset)}`; });
  addEventListener("hashchange", route);
  await route();
  document.body.dataset.ready = "true";
})();
