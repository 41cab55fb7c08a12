// The list of all decisions: filters, search, pages. Its state is in the page's address.

const PAGE = 20;
const RAW = 160; // characters of an answer
const FILTERS = ["q", "run", "seed", "condition", "agent", "outcome", "danger", "status", "differ", "asked", "page"];

class List {
  constructor(index, about, place) {
    Object.assign(this, { index, about, place });
    this.live = index.live;
    this.agents = [...new Set(index.scenes.map(([, , , , agent]) => agent).filter(Boolean))].sort();
    this.found = [];
    this.hits = null; // scenes whose answers or prompts have the text
    this.controls = this.form();
    this.count = h("p", { "aria-live": "polite", class: "quiet" });
    this.rows = h("div");
    this.pages = h("p", { class: "pages" });
    place.append(this.controls, this.count, this.rows, this.pages);
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
    const run = Math.min(Math.max(parseInt(of.run) || 0, 0), this.index.runs.length - 1);
    const { seeds } = this.index.runs[run], seed = seeds.find((s) => String(s) === of.seed) ?? seeds[0];
    return { ...of, run, seed, page: Math.max(parseInt(of.page) || 0, 0) };
  }

  form() {
    const { index, about, live } = this, words = endWords(live), several = index.runs.length > 1;
    const change = () => this.changed(), same = (names) => [...new Set(names)].map((name) => [String(name), name]);
    const filter = (label, name, options) => choice(label, name, [["", "any"], ...options], "", change);
    const met = index.runs.flatMap((run) => run.statuses).reduce((all, mask) => all | mask, 0);
    const outcomes = ["s", "d", "u", "n"].filter((end) => words[end]).map((end) => [end, words[end]]);
    const search = { type: "search", name: "q", placeholder: "scene; Enter: also in texts" };
    return h("form", { class: "filters" },
      h("label", {}, "search ",
        h("input", { ...search, oninput: change, onkeydown: (event) => this.pressed(event) })),
      several && choice("run", "run", about.names.map((name, n) => [String(n), name]), "0", change),
      choice("seed", "seed", same(index.runs.flatMap((run) => run.seeds)), null, change),
      filter("condition", "condition", same(index.runs.flatMap((run) => run.conditions))),
      this.agents.length ? filter("who decides", "agent", same(this.agents)) : null,
      filter("outcome", "outcome", [...outcomes, ...(live ? [["first", "where an episode begins to fail"]] : [])]),
      filter("danger", "danger", same(index.scenes.map(([, , , danger]) => danger ?? "none"))),
      filter("answers", "status", same(index.statuses.filter((_, n) => met & (1 << n)))),
      filter("differ", "differ", [
        ["conditions", "conditions disagree"],
        ...(several ? [["runs", "runs disagree"], ["answers", "the egos' own answers differ"]] : []),
      ]),
      filter("helpers", "asked", [["1", "asked"], ["0", "not asked"]]),
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

  // No submission: a page that a server shows in a sandbox has none.
  pressed(event) {
    if (event.key !== "Enter") return;
    event.preventDefault();
    this.search();
  }

  async search() {
    const text = (this.controls.elements.q.value ?? "").toLowerCase();
    if (!text) return;
    const hits = new Set(), { scenes, block: size } = this.index;
    for (let n = 0; n * size < scenes.length; n += 1) {
      // Not kept, as an opened block is: all of them together may be more than a telephone has room for.
      JSON.parse(await unpacked(`block-${n}`)).forEach((detail, k) => {
        const said = detail.runs.flatMap((run) => run?.answers ?? []).map((a) => [a.raw, a.status, a.repairs, a.error]);
        const all = JSON.stringify([detail.prompts, said]).toLowerCase();
        if (all.includes(JSON.stringify(text).slice(1, -1))) hits.add(n * size + k);
      });
      this.count.textContent = `searching, ${Math.min((n + 1) * size, scenes.length)} of ${scenes.length} …`;
    }
    [this.hits, this.hitsFor] = [hits, this.controls.elements.q.value];
    this.show();
  }

  wanted(n, state) {
    const [id, , , danger, agent] = this.index.scenes[n], { run, seed } = state, { conditions, statuses } = this.run;
    const here = (state.condition ? [state.condition] : conditions).filter((c) => this.action(n, run, c, seed) != null);
    const any = (kind, letter) => here.some((c) => this.letter(kind, n, run, c, seed) === letter);
    const actions = (of) => new Set(of.filter(Boolean)).size;
    const tests = {
      q: () => id.toLowerCase().includes(state.q.toLowerCase()) || this.hits?.has(n),
      agent: () => agent === state.agent,
      danger: () => (danger ?? "none") === state.danger,
      status: () => statuses[n] & (1 << this.index.statuses.indexOf(state.status)),
      asked: () => any("asked", state.asked),
      outcome: () => (state.outcome === "first" ? this.first.has(n) : any("ended", state.outcome)),
      differ: () => (state.differ === "conditions"
        ? actions(here.map((c) => this.action(n, run, c, seed))) > 1
        : state.differ === "answers"
          ? new Set(this.index.runs.map(({ said }) => said?.[n] ?? "-").filter((letter) => letter !== "-")).size > 1
        : here.some((c) => actions(this.index.runs.map((_, r) => this.action(n, r, c, seed))) > 1)),
    };
    return here.length > 0 && Object.entries(tests).every(([name, passes]) => !state[name] || passes());
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
    const here = this.found.length > PAGE ? `, ${page * PAGE + 1} to ${page * PAGE + shown.length} here` : "";
    const what = this.live ? "decision points" : "decisions";
    this.count.textContent = `${this.found.length} of ${this.index.scenes.length} ${what}${here}; seed ${state.seed}`;
    const egos = this.index.runs.length > 1 ? this.about.names.map((name) => `ego of ${name}`) : [];
    if (egos.length) this.count.textContent += `; conditions of ${visible(this.about.names[state.run])}`;
    const first = ["scene", ...(this.agents.length ? ["decides"] : []), "danger", ...egos];
    const heads = [...first, ...this.run.conditions, "not strict"];
    this.rows.replaceChildren(table("decisions", heads, shown.map((n) => this.row(n, state))));
    this.texts();
    const to = (n, text) => h("a", { href: `#${new URLSearchParams({ ...this.kept(state), decisions: "", page: n })}` }, text);
    this.pages.replaceChildren();
    fill(this.pages, {}, [page > 0 && to(page - 1, "← previous"), " ", page < last && to(page + 1, "next →")]);
  }

  row(n, state) {
    const [id, , , danger, agent] = this.index.scenes[n], { run, seed } = state;
    const odd = this.index.statuses.filter((s, k) => s !== "strict" && this.run.statuses[n] & (1 << k));
    const cell = (c) => {
      const action = this.action(n, run, c, seed), asked = this.letter("asked", n, run, c, seed) === "1";
      if (!action) return "–";
      const end = mark(this.letter("ended", n, run, c, seed), this.live);
      return [action, " ", end, asked && h("span", { class: "quiet" }, " asked")];
    };
    const link = h("a", { href: this.link(n, state), "data-n": n }, id);
    const own = this.index.runs.length > 1 ? this.index.runs.map((of, r) => this.own(n, r)) : [];
    const first = [link, ...(this.agents.length ? [agent ?? "ego"] : []), danger ?? "none"];
    return [...first, ...own, ...this.run.conditions.map(cell), odd.join(", ")];
  }

  // What a run's ego answered before fusion: the likeliest action, and room for its text.
  own(n, run) {
    const { said, sure } = this.index.runs[run], letter = said[n];
    if (letter === "-") return "–";
    const read = letter === "?" ? h("span", { class: "bad" }, "not readable") : `${this.index.actions[letter]} ${sure[n]} %`;
    return h("div", { class: "own", "data-n": n, "data-run": run }, read);
  }

  // The texts of the answers that are shown; not kept, as those of a search are not.
  async texts() {
    const parts = new Map(), { block: size } = this.index;
    for (const place of this.rows.querySelectorAll(".own")) {
      const { n, run } = place.dataset, part = Math.floor(n / size);
      if (!parts.has(part)) parts.set(part, JSON.parse(await unpacked(`block-${part}`)));
      const raw = parts.get(part)[n % size].runs[run]?.answers.find((answer) => answer.role === "ego")?.raw ?? "";
      fill(place, {}, [h("small", {}, raw.length > RAW ? `${raw.slice(0, RAW)}…` : raw || "nothing")]);
    }
  }

  // Who else decides in the same step of an episode, and this decision point, by agent.
  together(n, run, condition, seed) {
    const [, episode, step] = this.index.scenes[n];
    return this.index.scenes.map((_, k) => k).filter((k) => this.index.scenes[k][1] === episode
      && this.index.scenes[k][2] === step && this.action(k, run, condition, seed) != null);
  }

  kept(state) {
    const { page, scene, decisions, run, seed, ...rest } = state;
    return { ...rest, ...(run ? { run } : {}), ...(seed === this.index.runs[run].seeds[0] ? {} : { seed }) };
  }

  link(n, state) {
    return `#${new URLSearchParams({ scene: this.index.scenes[n][0], ...this.kept(state) })}`;
  }
}
