// What the address says is shown: the report, or one decision.

const report = document.getElementById("report"), single = document.getElementById("decision");
let about, index, list, drawn;

function themes() {
  const button = document.getElementById("theme"), root = document.documentElement;
  const dark = () => (root.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const say = () => { button.textContent = dark() ? "Light" : "Dark"; };
  button.addEventListener("click", () => { root.dataset.theme = dark() ? "light" : "dark"; say(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", say);
  button.hidden = false;
  say();
}

const show = (...content) => { single.replaceChildren(); fill(single, {}, content); };

async function decision(params) {
  const state = list.state, n = index.scenes.findIndex(([id]) => id === params.get("scene"));
  if (n < 0) {
    show(h("p", { class: "bad" }, `This report has no decision ${params.get("scene")}.`), h("p", {}, h("a", { href: "#decisions" }, "All decisions")));
    single.dataset.drawn = location.hash;
    return;
  }
  const [id, episode, step, danger] = index.scenes[n], detail = (await block(Math.floor(n / index.block)))[n % index.block];
  if (params.get("scene") !== new URLSearchParams(location.hash.slice(1)).get("scene")) return; // overtaken by another
  const told = detail.runs[state.run], of = about.runs[state.run];
  const made = (told?.decisions ?? []).filter((d) => d.seeds.includes(state.seed));
  const chosen = made.find((d) => d.condition === state.condition) ?? made.at(-1);
  const viewers = Object.keys(detail.world?.viewers ?? {}), viewer = viewers.includes(params.get("viewer")) ? params.get("viewer") : viewers[0];
  const half = params.get("zoom") === "near" ? 40 : about.ground.view_m;
  const go = (change) => { location.hash = new URLSearchParams({ ...Object.fromEntries(params), ...change }); };
  const pick = (label, name, options, selected) => choice(label, name, options, selected, (event) => go({ [name]: event.target.value }));
  const order = list.found.includes(n) ? list.found : index.scenes.map((_, k) => k), at = order.indexOf(n);
  const step_to = (k, text, key) => (order[k] == null ? null : h("a", { href: list.link(order[k], Object.assign(Object.fromEntries(params), { run: state.run, seed: state.seed })), "data-key": key }, text));
  const picture = h("div", { class: "picture" }), policies = h("div", { class: "chart" }), timeline = h("div", { class: "chart" });
  show(
    h("p", { class: "steps" }, h("a", { href: `#${new URLSearchParams({ ...list.kept(state), decisions: "" })}`, "data-key": "Escape" }, "← all decisions"), " ", step_to(at - 1, "← previous", "ArrowLeft"), " ", step_to(at + 1, "next →", "ArrowRight")),
    h("h1", { tabindex: "-1" }, `${index.live ? "Moment" : "Decision"} ${id}`),
    h("p", {}, `Episode ${episode}, step ${step}; ${danger ? `danger from ${danger}` : "no danger"}. `,
      made.map((d) => [h("span", { class: `verdict ${ENDS[d.end][0]}` }, `${d.condition}: ${d.action} ${ENDS[d.end][1]} ${endWords(index.live)[d.end]}`), " "])),
    h("form", { class: "filters" },
      about.names.length > 1 ? pick("run", "run", about.names.map((name, k) => [String(k), name]), String(state.run)) : null,
      pick("condition", "condition", made.map((d) => [d.condition, d.condition]), chosen?.condition),
      pick("seed", "seed", list.run.seeds.map((s) => [String(s), s]), String(state.seed)),
      viewers.length ? pick("seen by", "viewer", viewers.map((v) => [v, v]), viewer) : null,
      viewers.length ? pick("view", "zoom", [["far", "160 m"], ["near", "80 m"]], params.get("zoom") ?? "far") : null,
      h("button", { type: "button", onclick: (event) => copy(event.target, location.href) }, "Copy link")),
    told ? null : h("p", { class: "bad" }, "This run did not come to this scene."),
    h("div", { class: "pair" }, picture, h("div", {}, outcomes(detail, index.live, told ?? {}, state.seed))),
    h("h2", {}, "What was decided"),
    told ? table("decided", ["condition", "own entropy", "own weight", "replies", "fused", "action", "latency"], made.map((d) => [
      d.condition, `${number(d.entropy_nats, 3)}${d.triggered ? "; asked" : ""}${d.own_failed ? "; own answer failed" : ""}`, number(d.own_weight, 3),
      d.messages.length ? d.messages.map((m) => h("div", {}, `${m.from}: ${m.delivered ? `${m.arrival_ms.toFixed(1)} ms${m.on_time ? `, weight ${m.weight.toFixed(3)}` : ", too late"}` : "lost"}`)) : "none",
      distribution(index.actions, d.fused), [d.action, " ", mark(d.end, index.live), acted(d)], `${number(d.latency_ms, 1)} ms${d.deadline_missed ? ", outlasts the window" : ""}`])) : null,
    about.names.length > 1 ? [h("h3", {}, "The same decision in every run"), table("runs", ["run", ...new Set(index.runs.flatMap((run) => run.conditions))], about.names.map((name, r) =>
      [name, ...[...new Set(index.runs.flatMap((run) => run.conditions))].map((c) => [list.action(n, r, c, state.seed) ?? "–", " ", mark(list.letter("ended", n, r, c, state.seed), index.live)])]))] : null,
    h("div", { class: "figures" },
      h("figure", {}, h("h3", {}, "Distributions before and after fusion"), policies),
      h("figure", {}, h("h3", {}, "Latency, from seeing to acting"), timeline)),
    h("h2", {}, "Prompts and answers"),
    (told?.answers ?? []).map((answer) => answerSection(answer, detail, index.actions, about.meanings)));
  if (detail.world) {
    const [drawn_scene, said] = birdsEye(detail.world, about.ground, viewer, chosen?.messages ?? [], half);
    fill(picture, {}, [drawn_scene, h("p", { class: "quiet" }, `${said}. `, KEY), ["svg", "png"].map((kind) => [h("button", { type: "button", class: "small", onclick: () => saved(drawn_scene, id, kind) }, `Save as ${kind.toUpperCase()}`), " "])]);
  } else picture.append(h("p", {}, "No picture: this moment was not played again, or playing it again here does not come to it. `harness video` draws the whole episode."));
  if (told && chosen) {
    const shares = policyRows(told, chosen, index.actions), times = timelineRows(told, chosen, of);
    await chart(policies, `policies-${id}`, { ...about.policies, height: 15 * shares.length }, { values: shares });
    await chart(timeline, `timeline-${id}`, { ...about.timeline, height: 22 * new Set(times.map((row) => row.who)).size }, {
      values: times,
      window: of.points[chosen.condition].window_s ? [{ window_ms: 1000 * of.points[chosen.condition].window_s, what: "the decision window closes" }] : [],
    });
  }
  single.dataset.drawn = location.hash;
}

const KEY = "Blue: ego; green: helper; red with a ring: the dangerous vehicle; dashed: hidden from the viewer. Thin lines: sight. An arrow is the way in 1 s, × where paths cross. Thick lines to the ego: replies.";

// The picture with its look inside, as it has to stand alone.
async function saved(picture, id, kind) {
  const copy = picture.cloneNode(true), looks = ["fill", "stroke", "stroke-width", "stroke-dasharray", "opacity", "font-family", "font-weight", "text-anchor", "dominant-baseline", "paint-order", "vector-effect", "stroke-linejoin"];
  const from = picture.querySelectorAll("*"), to = copy.querySelectorAll("*");
  from.forEach((element, n) => to[n].setAttribute("style", looks.map((look) => `${look}:${getComputedStyle(element)[look]}`).join(";")));
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  const side = 1200, paper = getComputedStyle(picture).backgroundColor;
  copy.setAttribute("style", `background:${paper}`);
  copy.setAttribute("width", side);
  copy.setAttribute("height", side);
  const text = new XMLSerializer().serializeToString(copy);
  if (kind === "svg") return download(`scene-${id}.svg`, new Blob([text], { type: "image/svg+xml" }));
  const image = new Image(), canvas = h("canvas", { width: side, height: side });
  image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
  await image.decode();
  canvas.getContext("2d").drawImage(image, 0, 0);
  canvas.toBlob((content) => download(`scene-${id}.png`, content));
}

async function route() {
  const params = new URLSearchParams(location.hash.slice(1)), one = params.has("scene");
  report.hidden = one;
  single.hidden = !one;
  if (one) {
    delete single.dataset.drawn;
    await decision(params);
    scrollTo(0, 0);
    single.querySelector("h1")?.focus({ preventScroll: true });
    return;
  }
  list.show();
  drawn ??= drawAll(about.charts);
  if (params.has("decisions")) {
    const coming = document.getElementById("decisions").getBoundingClientRect().top;
    if (coming > innerHeight || coming < 0) document.getElementById("decisions").scrollIntoView();
  } else document.getElementById(location.hash.slice(1))?.scrollIntoView();
}

addEventListener("keydown", (event) => {
  if (single.hidden || event.target.closest("input, select, textarea, pre, [tabindex='0']") || event.altKey || event.ctrlKey || event.metaKey) return;
  [...single.querySelectorAll("[data-key]")].find((link) => link.dataset.key === event.key)?.click();
});

(async () => {
  themes();
  document.querySelectorAll("table[data-csv]").forEach(copied);
  document.querySelectorAll("table.sortable").forEach(sortable);
  [about, index] = (await Promise.all([unpacked("about"), unpacked("index")])).map(JSON.parse);
  list = new List(index, about, document.getElementById("list"));
  document.querySelectorAll("a[data-scene]").forEach((a) => { a.href = `#${new URLSearchParams({ scene: a.dataset.scene, run: a.dataset.run })}`; });
  addEventListener("hashchange", route);
  await route();
  document.body.dataset.ready = "true";
})();
