// The episode that was lost most often, decision by decision, as a film of pictures from above.

const PACE_MS = 1500; // that one decision is shown

class Replay {
  constructor(strips, about, place) {
    Object.assign(this, { strips, list: strips.list, about, place, at: 0 });
  }

  // Of the condition that the verdict is about, else of the first that lost any: the episode that most seeds lost.
  most() {
    const { list, strips } = this, { run } = list.state, { conditions, seeds } = list.run;
    for (const condition of [this.about.runs[run].best, ...conditions]) {
      const lossy = [...strips.episodes].map(([episode, scenes]) => {
        const lost = seeds.map((seed) => course(list, scenes, run, condition, seed)).filter((one) => one.lost);
        return { episode, condition, times: lost.length, ...lost[0] };
      }).filter(({ times }) => times).sort((a, b) => b.times - a.times);
      if (lossy.length) return { ...lossy[0], run, among: lossy.length };
    }
    return null;
  }

  async show() {
    const { list, place } = this, { run } = list.state, { scenes, block: size, live } = list.index;
    if (run === this.run) return;
    this.run = run;
    this.pause();
    const most = this.most();
    if (!most) return fill(place, {}, [h("p", {}, "No episode was lost under any condition.")]);
    const { path, ends } = most;
    const frames = await Promise.all(path.map(async (n) => ({ n, detail: (await block(Math.floor(n / size)))[n % size] })));
    const fails = live ? path.findIndex((n) => list.run.first.includes(n)) : ends.indexOf("u");
    this.at = fails < 0 ? path.length - 1 : fails;
    Object.assign(this, { most, frames, view: around(frames) });
    const [, , step, danger] = scenes[path[this.at]];
    this.button = h("button", { type: "button", onclick: () => this.play() });
    this.shown = h("div", { "aria-live": "polite" });
    const to = (by, text, label) => h("button", { type: "button", "aria-label": label, onclick: () => { this.pause(); this.move(by); } }, text);
    place.replaceChildren();
    fill(place, {}, [
      h("p", {}, `Under ${most.condition}, ${most.among} of ${this.strips.episodes.size} episodes are lost with at least one seed; most often `
        + `episode ${most.episode}, ${danger ? `danger from ${danger}` : "no danger"}: with ${most.times} of ${list.run.seeds.length}. `
        + `${live ? "It begins to fail" : "It is lost"} at step ${step}${this.instead()}.`),
      h("p", { class: "steps" }, this.button, to(-1, "←", "one decision back"), to(1, "→", "one decision on")),
      this.shown,
    ]);
    this.pause();
    this.draw();
  }

  // What lost the episode, and what would not have; in the closed loop, how it ended.
  instead() {
    const { detail } = this.frames[this.at], { outcomes: led } = detail, { action } = this.decision(detail);
    if (!led) {
      const { run, condition, seed } = this.most, { ends } = detail.runs[run];
      const end = ends?.find((e) => e.condition === condition && e.seed === seed);
      return end ? ` (${outcome(end)})` : "";
    }
    const safe = led.filter((o) => o.safe).map((o) => o.action).join(" and ");
    return ` by ${action} (${outcome(led.find((o) => o.action === action))}); ${safe || "nothing"} would have been safe`;
  }

  decision(detail) {
    const { run, seed, condition } = this.most;
    return detail.runs[run].decisions.find((d) => d.condition === condition && d.seeds.includes(seed));
  }

  move(by) {
    const to = this.at + by;
    if (to < 0 || to >= this.frames.length) return this.pause();
    this.at = to;
    this.draw();
  }

  play() {
    if (this.timer) return this.pause();
    this.at = -1;
    this.move(1);
    this.timer = setInterval(() => this.move(1), PACE_MS);
    this.button.textContent = "❚❚ Pause";
  }

  pause() {
    clearInterval(this.timer);
    this.timer = null;
    if (this.button) this.button.textContent = "▶ Play the episode";
  }

  draw() {
    const { most, strips, list, frames, at } = this, { n, detail } = frames[at], { world } = detail, { actions, live, scenes } = list.index;
    const decision = this.decision(detail), own = detail.runs[most.run].answers.find((a) => a.role === "ego");
    const [, , step, , agent] = scenes[n], [look, sign] = ENDS[most.ends[at]];
    const cells = most.path.map((scene, k) => {
      const cell = strips.cell(scene, k, most, most.run, most.condition);
      if (k === at) cell.setAttribute("aria-current", "step");
      return cell;
    });
    const facts = [
      ["its own answer", distribution(actions, own?.intent)],
      ["heard", decision.messages.length ? decision.messages.map((m) => h("div", {}, reply(m))) : "no reply"],
      ["both together", distribution(actions, decision.fused)],
    ];
    this.shown.replaceChildren();
    fill(this.shown, {}, [
      h("p", { class: "strip" }, cells),
      h("div", { class: "pair" },
        world ? birdsEye(world, this.about.ground, Object.keys(world.viewers)[0], decision.messages, this.view, [])[0]
          : h("p", { class: "quiet" }, "No picture of this decision point lies in the page."),
        h("div", {},
          h("p", {}, h("strong", {}, `Step ${step}${agent ? `, ${agent}` : ""}: ${decision.action}`), " ",
            live ? null : h("span", { class: look }, `${sign} ${endWords(live)[most.ends[at]]}`)),
          h("dl", {}, facts.map(([name, text]) => [h("dt", {}, name), h("dd", {}, text)])),
          own && [h("small", {}, "the answer as it came"), h("pre", {}, own.raw)],
          h("a", { href: strips.cell(n, at, most, most.run, most.condition).getAttribute("href") }, "All of this decision"),
          world && h("p", { class: "quiet" }, keyOf(world)))),
    ]);
  }
}

// The square that has all that the pictures of an episode show: its west and south ends, and its side.
function around(frames) {
  const views = frames.flatMap(({ detail: { world } }) => (world ? Object.values(Object.values(world.viewers)[0].views) : []));
  if (!views.length) return "all";
  const west = Math.min(...views.map(([x]) => x)), south = Math.min(...views.map(([, y]) => y));
  return [west, south, Math.max(...views.map(([x, y, side]) => Math.max(x + side - west, y + side - south)))];
}
