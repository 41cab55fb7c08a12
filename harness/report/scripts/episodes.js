// Episodes as strips of their decisions, those that lost most first: a cell is one decision, and opens it.

const STRIPS = 12; // shown until all are asked for

// Of an action: the side of a change of lane, else the first letter.
const initial = (action) => action.split("_").at(-1)[0];

// What an episode came to under one condition with one seed.
function course(list, scenes, run, condition, seed) {
  const path = scenes.filter((n) => list.action(n, run, condition, seed) != null);
  const ends = path.map((n) => list.letter("ended", n, run, condition, seed));
  // In the closed loop a letter is what the whole episode came to, and too late is a loss.
  const lost = ends.includes("u") || (list.live && ends.includes("d"));
  return { path, ends, seed, lost, slow: ends.filter((end) => end === "d").length };
}

class Episodes {
  constructor(list, colours, place) {
    Object.assign(this, { list, colours, place, every: false, by: "" });
    this.episodes = new Map();
    list.index.scenes.forEach(([, episode], n) => {
      this.episodes.set(episode, [...(this.episodes.get(episode) ?? []), n]);
    });
  }

  show() {
    const { list, place } = this, { run } = list.state, { conditions, seeds } = list.run;
    if (!conditions.includes(this.by)) this.by = "";
    const found = [...this.episodes].map(([episode, scenes]) => {
      const by = conditions.map((c) => seeds.map((seed) => course(list, scenes, run, c, seed)));
      const counted = by.filter((_, n) => !this.by || conditions[n] === this.by).flat();
      const sum = (of) => counted.reduce((total, one) => total + Number(one[of]), 0);
      return { episode, danger: list.index.scenes[scenes[0]][3], by, cost: [sum("lost"), sum("slow")] };
    }).filter(({ by }) => by.flat().some(({ path }) => path.length));
    found.sort((a, b) => b.cost[0] - a.cost[0] || b.cost[1] - a.cost[1]);
    const lossy = found.filter(({ cost }) => cost[0]).length;
    const shown = this.every ? found : found.slice(0, STRIPS);
    const rows = shown.map(({ episode, danger, by }) =>
      [String(episode), danger ?? "none", ...by.map((of, n) => this.strip(of, run, conditions[n]))]);
    const pick = choice("sorted by losses under", "by", [["", "all conditions"], ...conditions.map((c) => [c, c])], this.by,
      (event) => { this.by = event.target.value; this.show(); });
    place.replaceChildren();
    fill(place, {}, [
      h("form", { class: "filters" }, pick),
      h("p", { class: "quiet" }, `${lossy} of ${found.length} episodes are lost with at least one seed.`),
      table("episodes", ["episode", "danger", ...conditions], rows),
      found.length > shown.length
        && small(`Show all ${found.length}`, () => { this.every = true; this.show(); }),
    ]);
  }

  // With the first seed that loses the episode, where there is one.
  strip(of, run, condition) {
    const lost = of.filter((one) => one.lost), one = lost[0] ?? of[0];
    const said = lost.length ? `lost with ${lost.length} of ${of.length} seeds` : one.slow ? "slow" : "not lost";
    return one.path.length ? [
      this.byAgent(one.path).map(([agent, decisions]) => {
        const cells = h("span", { class: "strip" }, decisions.map(([n, k]) => this.cell(n, k, one, run, condition)));
        return agent ? h("div", {}, h("small", {}, `${agent} `), cells) : cells;
      }),
      h("small", { class: lost.length ? "bad" : "" }, said),
    ] : "–";
  }

  // Decisions with their places, of each agent on its own.
  byAgent(path) {
    const by = new Map();
    path.forEach((n, k) => {
      const agent = this.list.index.scenes[n][4];
      by.set(agent, [...(by.get(agent) ?? []), [n, k]]);
    });
    return [...by];
  }

  cell(n, k, { ends, lost, seed }, run, condition) {
    const { list } = this, { index } = list, action = list.action(n, run, condition, seed);
    // In the closed loop a decision has no end of its own, but where the episode begins to fail is known.
    const end = !index.live ? ends[k] : lost && list.run.first.includes(n) ? "u" : "s";
    const [colour, text] = this.colours[action];
    const asked = list.letter("asked", n, run, condition, seed) === "1";
    const words = { s: "safe", d: "safe, slower than the best", u: "the answer that lost this episode", n: "success was lost before" };
    const [, , step, , agent] = index.scenes[n];
    const told = `step ${step}${agent ? `, ${agent}` : ""}: ${action}${asked ? ", asked" : ""}${index.live && end === "s" ? "" : `, ${words[end]}`}`;
    return h("a", {
      class: `cell end-${end}`, href: list.link(n, { run, seed, condition }), title: told, "aria-label": told,
      style: end === "n" ? null : `background:${colour};color:${text}`,
    }, initial(action) + ({ u: "✗", d: "◷" }[end] ?? ""));
  }
}
