// One decision: the scene, who answered what to which prompt, what was fused from it, and what came of it.

const ENDS = { s: ["good", "✓"], d: ["slow", "◷"], u: ["bad", "✗"], n: ["", "○"], "-": ["quiet", ""] };
const endWords = (live) => (live
  ? { s: "success", d: "cleared too late", u: "failed", n: "", "-": "not in this moment" }
  : { s: "safe", d: "safe, slower than the best", u: "unsafe", n: "no action was safe", "-": "not decided" });

const mark = (end, live) => h("span", { class: ENDS[end][0], title: endWords(live)[end] }, ENDS[end][1]);

const table = (name, heads, rows) => {
  const made = h("table", { "data-csv": name },
    h("thead", {}, h("tr", {}, heads.map((head) => h("th", { scope: "col" }, head)))),
    h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, n) =>
      n === 0 ? h("th", { scope: "row" }, cell) : h("td", {}, cell))))));
  const box = h("div", {}, h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": name }, made));
  copied(made);
  return box;
};

// Characters as the parser counts them, not as UTF-16 does.
function highlighted(raw, spans) {
  const characters = Array.from(raw), pieces = [];
  let at = 0;
  for (const [from, to] of spans) {
    pieces.push(characters.slice(at, from).join(""), h("mark", {}, characters.slice(from, to).join("")));
    at = to;
  }
  return h("pre", {}, pieces, characters.slice(at).join(""));
}

const distribution = (actions, p) => (p ? actions.map((a, n) => `${a} ${p[n].toFixed(2)}`).join(", ") : "none");

function answerSection(answer, detail, actions, meanings) {
  const facts = [
    answer.detail,
    answer.finish_reason && answer.finish_reason !== "stop" ? `finish reason ${answer.finish_reason}` : null,
    answer.error ? `engine: ${answer.error}` : null,
    answer.prompt_tokens ? `${answer.prompt_tokens} tokens in` : null,
    answer.completion_tokens ? `${answer.completion_tokens} out` : null,
    answer.seconds ? `${answer.seconds.toFixed(3)} s` : null,
    answer.label_mass != null ? `${(100 * answer.label_mass).toFixed(2)} % of the probability on the letters` : null,
    answer.retries ? `${answer.retries} failed attempts before` : null,
    answer.cached ? "from the cache" : null,
  ].filter(Boolean).join("; ");
  const sent = answer.prompt == null ? null : detail.prompts[answer.prompt];
  const message = Object.entries(answer.message ?? {});
  return h("section", { class: "answer" },
    h("h4", {}, `${answer.viewer}, ${answer.role} `, h("span", { class: "tag", title: meanings[answer.status] }, answer.status),
      (answer.repairs ?? []).map((repair) => [" ", h("span", { class: "tag", title: meanings[repair] }, repair)])),
    h("p", { class: "quiet" }, facts),
    h("div", { class: "pair" },
      h("div", {}, h("small", {}, answer.spans.length ? "raw answer; marked: what was read" : "raw answer"), highlighted(answer.raw, answer.spans)),
      h("div", {},
        h("small", {}, "as read"), h("p", {}, distribution(actions, answer.intent)),
        answer.mass != null && Math.abs(answer.mass - 1) > 1e-3 ? h("p", { class: "quiet" }, `the model's numbers sum to ${answer.mass.toFixed(3)}`) : null,
        message.length ? h("dl", {}, message.map(([name, text]) => [h("dt", {}, name), h("dd", {}, text)])) : null)),
    sent
      ? h("details", {}, h("summary", {}, `prompt, ${sent.length} messages`), sent.map((m) => [h("small", {}, m.role), h("pre", {}, m.content)]))
      : h("p", { class: "quiet" }, "prompt: not here as it was sent"));
}

const outcome = (o) => [o.result.replaceAll("_", " "), o.partner ? ` with ${o.partner}` : "", o.fault ? `, fault: ${o.fault}` : ""].join("");

function outcomes(detail, live, told, seed) {
  if (detail.outcomes) {
    return [h("h3", {}, "What each action leads to"),
      table("outcomes", ["action", "outcome", "delay", "least gap"], detail.outcomes.map((o) => [
        o.action, [h("span", { class: o.safe ? "good" : "bad" }, o.safe ? "✓ safe" : "✗ unsafe"), h("small", {}, outcome(o))],
        o.delay_s == null ? "–" : `${o.delay_s.toFixed(2)} s`, `${number(o.least_gap_m, 1)} m`])),
      h("p", { class: "quiet" }, "Each action once, then the full-view driver. Delay is against the best safe action.")];
  }
  const ends = (told.ends ?? []).filter((e) => e.seed === seed);
  return [h("h3", {}, "What became of the episode"),
    table("ends", ["condition", "result", "at", "least gap"], ends.map((e) => [
      e.condition, [h("span", { class: e.result === "cleared" ? "good" : "bad" }, outcome(e)),
        h("small", {}, `hard brakings: ${number(e.hard_brakings, 0)}${e.delay_s == null ? "" : `; ${e.delay_s.toFixed(2)} s after the full-view driver`}`)],
      `${number(e.time_s, 2)} s`, `${number(e.least_gap_m, 1)} m`]))];
}

function policyRows(told, chosen, actions) {
  const rows = [], add = (who, what, p) => p && actions.forEach((action, n) => rows.push({ who, what, action, p: p[n], order: rows.length }));
  for (const a of told.answers.filter((a) => !a.viewer.includes("+"))) {
    const weight = a.role === "ego" ? chosen?.own_weight : chosen?.messages.find((m) => m.from === a.viewer)?.weight;
    add(`${a.viewer}, ${a.role}`, weight == null ? "before fusion" : `before fusion; weight ${weight.toFixed(3)}`, a.intent);
  }
  if (chosen) add(`fused, ${chosen.condition}`, "after fusion", chosen.fused);
  return rows;
}

const acted = (d) => (d.acts_at_s == null ? null : h("small", {}, d.acted ? `acts at ${d.acts_at_s.toFixed(2)} s` : "was not ready in time"));

function timelineRows(told, chosen, about) {
  const seconds = about.inference_s, by = (a) =>
    1000 * (a.seconds && seconds == null ? a.seconds : typeof seconds === "object" && seconds ? seconds[a.role] ?? seconds.ego ?? 0 : seconds ?? 0);
  const rows = [];
  for (const a of told.answers.filter((a) => !a.viewer.includes("+"))) {
    const m = chosen.messages.find((m) => m.from === a.viewer);
    if (a.role !== "ego" && !m) continue;
    const who = `${a.viewer}, ${a.role}`, ready = by(a);
    if (ready) rows.push({ who, what: "inference", from: 0, to: ready });
    if (m) {
      const to = m.delivered ? m.arrival_ms : Math.min(chosen.latency_ms, 1000 * (about.points[chosen.condition].window_s ?? 0));
      rows.push({ who, what: m.on_time ? "reply on time" : m.delivered ? "reply late" : "reply lost", from: Math.min(ready, to), to });
    }
  }
  // ego-prompt infers once more when the exchange is over; a rule takes no time.
  const point = about.points[chosen.condition], fusion = point.consensus === "ego-prompt" && chosen.messages.some((m) => m.on_time) ? 1000 * (about.merge_s ?? 0) : 0;
  if (fusion) rows.push({ who: rows[0]?.who ?? "ego", what: "fusion", from: chosen.latency_ms - fusion, to: chosen.latency_ms });
  if (chosen.latency_ms != null) rows.push({ who: "decision", what: "decision", from: 0, to: chosen.latency_ms });
  return rows;
}
