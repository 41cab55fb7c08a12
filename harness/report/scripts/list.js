// The list of all decisions: filters, search, pages. Its state is in the page's address.

const PAGE = 50;
const FILTERS = ["q", "run", "seed", "condition", "outcome", "danger", "status", "differ", "asked", "page"];

class List {
  constructor(index, about, place) {
    Object.assign(this, { index, about, place });
    this.live = index.live;
    this.found = [];
    this.hits = null; // scenes whose answers or prompts have the text
    place.append(this.form(), this.count = h("p", { "aria-live": "polite", class: "quiet" }), this.rows = h("div"), this.pages = h("p", { class: "pages" }));
  }

  // The letter of one scene, run, condition and seed.
  letter(kind, n, run, condition, seed) {
    const of = this.index.runs[run], c = of.conditions.indexOf(condition), s = of.seeds.indexOf(seed);
    return c < 0 || s < 0 ? "-" : of[kind][(n * of.conditions.length + c) * of.seeds.length + s];
  }

  action(n, run, condition, seed) {
    const letter = this.letter("acted", n, run, condition, seed);
    return letter === "-" ? null : this.index.actions[letter];
  }

  get run() { return this.index.runs[this.state.run]; }
  get state() {
    const of = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
    const run = Math.min(Math.max(parseInt(of.run) || 0, 0), this.index.runs.length - 1), seeds = this.index.runs[run].seeds;
    return { ...of, run, seed: seeds.find((s) => String(s) === of.seed) ?? seeds[0], page: Math.max(parseInt(of.page) || 0, 0) };
  }

  form() {
    const words = endWords(this.live), any = ["", "any"];
    const dangers = [...new Set(this.index.scenes.map((scene) => scene[3]))];
    const met = this.index.runs.reduce((all, run) => run.statuses.reduce((a, b) => a | b, all), 0);
    const statuses = this.index.statuses.filter((_, n) => met & (1 << n));
    const several = this.index.runs.length > 1, change = () => this.changed();
    return this.controls = h("form", { class: "filters" },
      h("label", {}, "search ", h("input", { type: "search", name: "q", placeholder: "scene; Enter: also in answers", oninput: change, onkeydown: (event) => this.pressed(event) })),
      several ? choice("run", "run", this.about.names.map((name, n) => [String(n), name]), "0", change) : null,
      choice("seed", "seed", this.index.runs[0].seeds.map((s) => [String(s), s]), null, change),
      choice("condition", "condition", [any, ...[...new Set(this.index.runs.flatMap((run) => run.conditions))].map((c) => [c, c])], "", change),
      choice("outcome", "outcome", [any, ["s", words.s], ["d", words.d], ["u", words.u], ...(this.live ? [] : [["n", words.n]]), ["first", "where an episode begins to fail"]], "", change),
      choice("danger", "danger", [any, ...dangers.map((d) => [d ?? "none", d ?? "none"])], "", change),
      choice("answers", "status", [any, ...statuses.map((s) => [s, s])], "", change),
      choice("differ", "differ", [any, ["conditions", "conditions disagree"], ...(several ? [["runs", "runs disagree"]] : [])], "", change),
      choice("help", "asked", [any, ["1", "asked for"], ["0", "not asked for"]], "", change),
      h("button", { type: "reset", onclick: () => setTimeout(change) }, "Clear"));
  }

  changed() {
    const values = Object.fromEntries([...new FormData(this.controls)].filter(([, value]) => value !== ""));
    if (values.run === "0") delete values.run;
    if (values.seed === String(this.index.runs[values.run ?? 0].seeds[0])) delete values.seed;
    if (values.q !== this.hitsFor) this.hits = null;
    history.replaceState(null, "", `#${new URLSearchParams({ decisions: "", ...values })}`);
    this.show();
  }

  // No submission: a page in a sandbox, as `harness view` shows it, has none.
  pressed(event) {
    if (event.key !== "Enter") return;
    event.preventDefault();
    this.search();
  }

  async search() {
    const text = (this.controls.elements.q.value ?? "").toLowerCase();
    if (!text) return;
    const hits = new Set(), size = this.index.block;
    for (let n = 0; n * size < this.index.scenes.length; n += 1) {
      (await block(n)).forEach((detail, k) => {
        const said = [detail.prompts, detail.runs.map((run) => run?.answers.map((a) => [a.raw, a.status, a.repairs, a.error]))];
        if (JSON.stringify(said).toLowerCase().includes(JSON.stringify(text).slice(1, -1))) hits.add(n * size + k);
      });
      this.count.textContent = `searching, ${Math.min((n + 1) * size, this.index.scenes.length)} of ${this.index.scenes.length} …`;
    }
    [this.hits, this.hitsFor] = [hits, this.controls.elements.q.value];
    this.show();
  }

  wanted(n, state) {
    const [id, , , danger] = this.index.scenes[n], { run, seed } = state;
    const conditions = state.condition ? [state.condition] : this.run.conditions;
    const here = conditions.filter((c) => this.action(n, run, c, seed) != null);
    if (!here.length) return false;
    if (state.q && !id.toLowerCase().includes(state.q.toLowerCase()) && !this.hits?.has(n)) return false;
    if (state.danger && (danger ?? "none") !== state.danger) return false;
    if (state.status && !(this.run.statuses[n] & (1 << this.index.statuses.indexOf(state.status)))) return false;
    if (state.asked && !here.some((c) => this.letter("asked", n, run, c, seed) === state.asked)) return false;
    if (state.outcome === "first" && !this.first.has(n)) return false;
    if (state.outcome && state.outcome !== "first" && !here.some((c) => this.letter("ended", n, run, c, seed) === state.outcome)) return false;
    if (state.differ === "conditions" && new Set(here.map((c) => this.action(n, run, c, seed))).size < 2) return false;
    return state.differ !== "runs" || conditions.some((c) =>
      new Set(this.index.runs.map((_, r) => this.action(n, r, c, seed)).filter(Boolean)).size > 1);
  }

  // Takes the state from the address: the same address shows the same list.
  show() {
    const state = this.state;
    for (const name of FILTERS) {
      const control = this.controls.elements[name];
      if (control && document.activeElement !== control) control.value = state[name] ?? "";
    }
    this.first = new Set(this.run.first);
    this.found = this.index.scenes.map((_, n) => n).filter((n) => this.wanted(n, state));
    const last = Math.max(Math.ceil(this.found.length / PAGE) - 1, 0), page = Math.min(state.page, last);
    const shown = this.found.slice(page * PAGE, (page + 1) * PAGE);
    this.count.textContent = `${this.found.length} of ${this.index.scenes.length} ${this.live ? "moments" : "decisions"}`
      + `${this.found.length > PAGE ? `, ${page * PAGE + 1} to ${page * PAGE + shown.length} here` : ""}; seed ${state.seed}`;
    const to = (n) => `#${new URLSearchParams({ ...this.kept(state), decisions: "", page: n })}`;
    this.rows.replaceChildren(table("decisions", ["scene", "danger", ...this.run.conditions, "not strict"], shown.map((n) => {
      const [id, , , danger] = this.index.scenes[n];
      const odd = this.index.statuses.filter((s, k) => s !== "strict" && this.run.statuses[n] & (1 << k));
      return [h("a", { href: this.link(n, state), "data-n": n }, id), danger ?? "none", ...this.run.conditions.map((c) => {
        const action = this.action(n, state.run, c, state.seed);
        return action ? [action, " ", mark(this.letter("ended", n, state.run, c, state.seed), this.live), this.letter("asked", n, state.run, c, state.seed) === "1" ? h("span", { class: "quiet" }, " asked") : null] : "–";
      }), odd.join(", ")];
    })));
    this.pages.replaceChildren(...(page > 0 ? [h("a", { href: to(page - 1) }, "← before"), " "] : []), ...(page < last ? [h("a", { href: to(page + 1) }, "next →")] : []));
  }

  kept(state) {
    const { page, scene, decisions, run, seed, ...rest } = state;
    return { ...rest, ...(run ? { run } : {}), ...(seed === this.index.runs[run].seeds[0] ? {} : { seed }) };
  }

  link(n, state) {
    return `#${new URLSearchParams({ scene: this.index.scenes[n][0], ...this.kept(state) })}`;
  }
}
