// The page of one decision: the scene, the answers with their prompts, the fused policy and its outcome.

const outcome = ({ result, partner, fault }) =>
  result.replaceAll("_", " ") + (partner ? ` with ${partner}` : "") + (fault ? `, fault: ${fault}` : "");

function outcomes(actions) {
  const rows = actions.map((o) => [
    o.action,
    [h("span", { class: o.safe ? "good" : "bad" }, o.safe ? "✓ safe" : "✗ unsafe"), h("small", {}, outcome(o))],
    number(o.delay_s, 2, "s"),
    number(o.time_s, 2, "s"),
  ]);
  return [
    h("h3", {}, "What each action leads to"),
    table("outcomes", ["action", "outcome", "delay", "at"], rows),
    h("p", { class: "quiet" }, "Safe: success is still possible after the action. The outcome is how the episode ends "
      + "if the full-view driver takes over then. Delay is the time that the action adds to the earliest possible success."),
  ];
}

function endings(ends) {
  const late = (e) => (e.delay_s == null ? "" : `; ${number(e.delay_s, 2, "s")} after the full-view driver`);
  const rows = ends.map((e) => [
    e.condition,
    [
      h("span", { class: e.result === "cleared" ? "good" : "bad" }, outcome(e)),
      h("small", {}, `hard brakings: ${number(e.hard_brakings, 0)}${late(e)}`),
    ],
    number(e.time_s, 2, "s"),
    number(e.least_gap_m, 1, "m"),
    number(e.least_ttc_s, 2, "s"),
    number(e.least_pet_s, 2, "s"),
  ]);
  return [
    h("h3", {}, "How the episode ended"),
    table("ends", ["condition", "result", "at", "least gap", "least TTC", "least PET"], rows),
  ];
}

function reply(m) {
  const who = m.attacker ? `${m.from} (attacker)` : m.from;
  if (!m.delivered) return `${who}: lost`;
  const worth = [m.weight == null ? "on time" : `weight ${number(m.weight, 3)}`];
  if (m.trust != null) worth.push(`trust ${number(m.trust, 2)}`);
  return `${who}: ${number(m.arrival_ms, 1, "ms")}, ${m.on_time ? worth.join(", ") : "too late"}`;
}

const acted = (d) => d.acts_at_s != null
  && h("small", {}, d.acted ? `acts at ${number(d.acts_at_s, 2, "s")}` : "not ready before the episode ended");

// Second answers of the ego are in the fused policy. Under some conditions helpers are heard who were asked another
// question, or agents, whose plans are the answers that they gave from their own seats.
function first(record, point, together) {
  const speaks = point.content === "plan" ? "plan" : point.question || "helper";
  const plans = together.filter((each) => !each.here && each.own).map(({ own }) => ({ ...own, role: "plan" }));
  return [...record.answers, ...plans].filter((a) => a.role === "ego" || a.role === speaks);
}

function policyRows(record, chosen, actions, run, together) {
  const rows = [];
  const add = (who, what, p) => actions.forEach((action, n) => rows.push({ who, what, action, p: p[n] }));
  for (const a of first(record, run.points[chosen.condition], together)) {
    const message = chosen.messages.find((m) => m.from === sender(a));
    const weight = a.role === "ego" ? chosen.own_weight : message?.weight;
    const before = weight == null ? "before fusion" : `before fusion; weight ${number(weight, 3)}`;
    const what = message?.attacker ? "what it intends; the attack changed what it sent" : before;
    if (a.intent) add(who(a), what, a.intent);
  }
  add(`fused, ${chosen.condition}`, "after fusion", chosen.fused);
  return rows;
}

// Inference as the run took it: an answer's own time, that of its agent's model, or with one model that of its role.
function timelineRows(record, chosen, run, together) {
  const rows = [], point = run.points[chosen.condition], { latency_ms } = chosen;
  for (const a of first(record, point, together)) {
    const usual = run.inference_s[a.role === "ego" || a.role === "merge" ? "ego" : "helper"];
    const ready = 1000 * (a.took_s === undefined ? usual : a.took_s); // null where an answer never came
    const m = chosen.messages.find((m) => m.from === sender(a)), name = who(a);
    if (a.role !== "ego" && !m) continue;
    if (ready) rows.push({ who: name, what: "inference", from: 0, to: ready });
    if (!m) continue;
    const to = m.delivered ? m.arrival_ms : Math.min(latency_ms, 1000 * (point.window_s ?? 0));
    const what = m.on_time ? "reply on time" : m.delivered ? "reply late" : "reply lost";
    rows.push({ who: name, what, from: Math.min(ready, to), to });
  }
  // ego-prompt infers once more when the exchange is over; a rule takes no time.
  const fusion = chosen.fusion_ms;
  if (fusion) rows.push({ who: rows[0]?.who ?? "ego", what: "fusion", from: latency_ms - fusion, to: latency_ms });
  if (latency_ms != null) rows.push({ who: "decision", what: "decision", from: 0, to: latency_ms });
  return rows;
}

class DecisionPage {
  constructor(place, list, index, about) {
    Object.assign(this, { place, list, index, about });
  }

  show(...content) {
    this.place.replaceChildren();
    fill(this.place, {}, content);
  }

  // What the address asks for; false where there is no such decision, or another was asked for meanwhile.
  async find(params) {
    const { list, index, about } = this, name = params.get("scene"), state = list.state;
    const n = index.scenes.findIndex(([id]) => id === name);
    if (n < 0) {
      this.show(
        h("p", { class: "bad" }, `This report has no decision ${name}.`),
        h("p", {}, h("a", { href: "#decisions" }, "All decisions")),
      );
      return false;
    }
    this.everything = (await opened)[name];
    const detail = this.everything ?? (await block(Math.floor(n / index.block)))[n % index.block];
    const record = detail.runs[state.run], decisions = (record?.decisions ?? []).filter((d) => d.seeds.includes(state.seed));
    const viewers = Object.keys(detail.world?.viewers ?? {}), viewer = params.get("viewer");
    Object.assign(this, { n, params, state, detail, record, decisions, viewers });
    this.chosen = decisions.find((d) => d.condition === state.condition) ?? decisions.at(-1);
    this.viewer = viewers.includes(viewer) ? viewer : viewers[0];
    this.run = about.runs[state.run];
    this.together = await this.others();
    this.conditions = [...new Set(index.runs.flatMap((run) => run.conditions))];
    return name === new URLSearchParams(location.hash.slice(1)).get("scene");
  }

  // Of each agent that decides in this step: its id, its decision point, what it decided, and its page.
  async others() {
    const { list, index, n, state, chosen, params } = this, [, , , , agent] = index.scenes[n];
    if (!agent || !chosen) return [];
    const { viewer, scene, ...rest } = Object.fromEntries(params);
    return Promise.all(list.together(n, state.run, chosen.condition, state.seed).map(async (k) => {
      const detail = k === n ? this.detail : (await block(Math.floor(k / index.block)))[k % index.block];
      const record = detail.runs[state.run];
      const decision = record.decisions.find((d) => d.seeds.includes(state.seed) && d.condition === chosen.condition);
      const own = record.answers.find((a) => a.role === "ego");
      const href = list.link(k, { ...rest, run: state.run, seed: state.seed, condition: chosen.condition });
      return { id: index.scenes[k][4], here: k === n, decision, own, href };
    }));
  }

  agents() {
    if (!this.together.length) return null;
    const { actions } = this.index, { condition } = this.chosen;
    return [
      h("h3", {}, `What each agent decided in this step, under ${condition}`),
      table("agents", ["agent", "its own intent", "what it heard", "fused", "action"], this.together.map((each) => [
        [
          each.here ? h("strong", {}, each.id) : h("a", { href: each.href }, each.id),
          each.own?.agent && h("small", {}, each.own.agent),
        ],
        distribution(actions, each.own?.intent),
        each.decision.messages.length ? each.decision.messages.map((m) => h("div", {}, reply(m))) : "asked nobody",
        distribution(actions, each.decision.fused),
        [each.decision.action, acted(each.decision)],
      ])),
    ];
  }

  async draw(params) {
    if (await this.find(params)) {
      const policies = h("div", { class: "chart" }), timeline = h("div", { class: "chart" });
      this.show(
        this.steps(), this.title(), this.controls(),
        this.record ? null : h("p", { class: "bad" }, "This run did not reach this scene."),
        h("div", { class: "pair" },
          this.picture(),
          h("div", {}, this.came(), h("h3", {}, "Distributions before and after fusion"), policies)),
        this.cameras(),
        this.leftOut(),
        h("h2", {}, "What was decided"),
        this.record ? this.decided() : null,
        this.agents(),
        this.messages(),
        this.about.names.length > 1 ? this.inEveryRun() : null,
        h("h3", {}, "Latency, from seeing to acting"), timeline,
        h("h2", {}, "Prompts and answers"),
        (this.record?.answers ?? []).map((answer) =>
          answerSection(answer, this.detail, this.index.actions, this.about.meanings,
            this.record.left_out?.filter((each) => each.role === answer.role && each.viewer === answer.viewer))),
      );
      if (this.chosen) await this.charts(policies, timeline);
    }
    this.place.dataset.drawn = location.hash;
  }

  steps() {
    const { list, index, n, state, params } = this;
    const order = list.found.includes(n) ? list.found : index.scenes.map((_, k) => k), at = order.indexOf(n);
    const kept = { ...Object.fromEntries(params), run: state.run, seed: state.seed };
    const to = (k, text, key) => order[k] != null && h("a", { href: list.link(order[k], kept), "data-key": key }, text);
    const back = `#${new URLSearchParams({ ...list.kept(state), decisions: "" })}`;
    return h("p", { class: "steps" },
      h("a", { href: back, "data-key": "Escape" }, "← all decisions"), " ",
      to(at - 1, "← previous", "ArrowLeft"), " ",
      to(at + 1, "next →", "ArrowRight"));
  }

  title() {
    const [id, episode, step, danger, agent] = this.index.scenes[this.n], words = endWords(this.index.live);
    const own = this.record?.answers.find((a) => a.role === "ego");
    return [
      h("h1", { tabindex: "-1" }, `${this.index.live ? "Decision point" : "Decision"} ${id}`),
      h("p", {}, `Episode ${episode}, step ${step}; `, agent && [h("strong", {}, `${agent} decides`), own?.agent && ` with ${own.agent}`, "; "], `${danger ? `danger from ${danger}` : "no danger"}. `,
        this.decisions.map((d) => {
          const [look, sign] = ENDS[d.end];
          return [h("span", { class: `verdict ${look}` }, `${d.condition}: ${d.action} ${sign} ${words[d.end]}`), " "];
        })),
    ];
  }

  controls() {
    const go = (change) => { location.hash = new URLSearchParams({ ...Object.fromEntries(this.params), ...change }); };
    const pick = (label, name, options, selected) =>
      choice(label, name, options, selected, (event) => go({ [name]: event.target.value }));
    const same = (names) => names.map((name) => [String(name), name]), { names } = this.about;
    return h("form", { class: "filters" },
      names.length > 1 ? pick("run", "run", names.map((name, k) => [String(k), name]), String(this.state.run)) : null,
      pick("condition", "condition", same(this.decisions.map((d) => d.condition)), this.chosen?.condition),
      pick("seed", "seed", same(this.list.run.seeds), String(this.state.seed)),
      this.viewer ? pick("seen by", "viewer", same(this.viewers), this.viewer) : null,
      this.viewer ? pick("view", "zoom", [["", "the conflict"], ["all", "all, 160 m"]], this.params.get("zoom") ?? "") : null,
      h("button", { type: "button", onclick: (event) => copy(event.target, location.href) }, "Copy link"));
  }

  picture() {
    const { world } = this.detail, { ground } = this.about, [id] = this.index.scenes[this.n];
    if (!world) {
      return h("p", { class: "picture" }, this.everything
        ? "No picture: it could not be played again here."
        : "No picture: the page has pictures of the most telling decision points only. `harness run video` draws the whole episode.");
    }
    const [drawing, said] = birdsEye(
      world, ground, this.viewer, this.chosen?.messages ?? [], this.params.get("zoom"), this.together);
    const save = (kind) => small(`Save as ${kind.toUpperCase()}`, () => saved(drawing, id, kind));
    return h("div", { class: "picture" },
      drawing, h("p", { class: "quiet" }, `${said}. `, keyOf(world), this.together.length ? KEY_OF_AGENTS : ""), save("svg"), " ", save("png"));
  }

  cameras() {
    const { world, cameras } = this.detail;
    if (!world || !cameras) return null;
    const boxes = h("input", { type: "checkbox", checked: this.boxes !== false, onchange: () => { this.boxes = boxes.checked; } });
    return h("section", { class: "cameras" },
      h("h3", {}, "What the cameras saw"),
      h("p", { class: "quiet" }, shownTo(this.record?.answers ?? [], this.viewers), " Front above rear, each 120° wide. ",
        h("label", {}, boxes, " boxes around what the sensors list")),
      h("div", { class: "frames" }, this.viewers.map((viewer) => cameraFrame(world, viewer, cameras[viewer]))));
  }

  // What is known of this decision and not in the page, and how to see it.
  leftOut() {
    const unread = this.record?.answers.some((answer) => answer.prompt === false), { world, cameras } = this.detail;
    const left = [
      !world && "the scene from above", !cameras && "the camera pictures", unread && "the prompts, which the model does not read",
    ].filter(Boolean).join("; ");
    if (!left || this.everything) return null;
    if (!document.querySelector(".way-back")) {
      return h("p", { class: "quiet" }, `Not in this page: ${left}. `, h("code", {}, "harness view"), " shows them; ",
        h("code", {}, "harness report RUN --full"), " writes a page that has them.");
    }
    const query = new URLSearchParams(location.search);
    query.set("scene", this.index.scenes[this.n][0]);
    return h("p", { class: "quiet" }, `Not in this page: ${left}. `, h("a", { href: `?${query}${location.hash}` }, "Show them"));
  }

  came() {
    if (this.detail.outcomes) return outcomes(this.detail.outcomes);
    return endings((this.record?.ends ?? []).filter((e) => e.seed === this.state.seed));
  }

  decided() {
    const heads = ["condition", "own entropy", "own weight", "replies", "fused", "action", "latency"];
    return table("decided", heads, this.decisions.map((d) => [
      d.condition,
      `${number(d.entropy_nats, 3)}${d.triggered ? "; asked" : ""}${d.own_failed ? "; own answer failed" : ""}`,
      number(d.own_weight, 3),
      d.messages.length ? d.messages.map((m) => h("div", {}, reply(m))) : "none",
      distribution(this.index.actions, d.fused),
      [d.action, " ", mark(d.end, this.index.live), acted(d)],
      `${number(d.latency_ms, 1, "ms")}${d.deadline_missed ? ", longer than the window" : ""}`,
    ]));
  }

  messages() {
    const leftOut = this.record?.left_out?.filter((each) => each.role === "fusion") ?? [], [one] = leftOut;
    return one && moved(leftOut,
      `effect of leaving out one message at a time, under ${one.condition} with seed ${one.seed}`);
  }

  inEveryRun() {
    const { list, index, n, state } = this;
    const cell = (run, condition) => [
      list.action(n, run, condition, state.seed) ?? "–", " ",
      mark(list.letter("ended", n, run, condition, state.seed), index.live),
    ];
    return [
      h("h3", {}, "The same decision in every run"),
      table("runs", ["run", ...this.conditions], this.about.names.map((name, run) =>
        [name, ...this.conditions.map((condition) => cell(run, condition))])),
    ];
  }

  async charts(policies, timeline) {
    const { record, chosen, run } = this, [id] = this.index.scenes[this.n];
    const shares = policyRows(record, chosen, this.index.actions, run, this.together);
    const times = timelineRows(record, chosen, run, this.together);
    const window_s = run.points[chosen.condition].window_s, lines = new Set(times.map((row) => row.who)).size;
    await chart(policies, `policies-${id}`, { ...this.about.policies, height: 13 * shares.length }, { values: shares });
    await chart(timeline, `timeline-${id}`, { ...this.about.timeline, height: 22 * lines }, {
      values: times,
      window: window_s ? [{ window_ms: 1000 * window_s, what: "the decision window closes" }] : [],
    });
  }
}
