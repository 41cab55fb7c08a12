// What one vehicle answered: raw, as it was read, and to which prompt.

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

const distribution = (actions, p) => (p ? actions.map((a, n) => `${a} ${number(p[n], 2)}`).join(", ") : "none");

const sender = (answer) => answer.viewer.replace(/~\w+/, "");
// Who answered, and whom it had heard: "v1 + v2 (objects) + v3 blind (objects), fusion". Before it asks anybody the ego
// may have heard what is sent unasked: "v1 + v2 (stream), ego".
const heard = (key) =>
  key.replaceAll("+", " + ").replace(/~(\w+)/g, " $1").replace(/!([^ ]+)/g, (_, what) => ` (${what.replaceAll("&", ", ").replace(/^(plan:.*|stream:[^,]*)/, (part) => part.split(":")[0])})`);
const roleWord = ({ role, viewer }) => (role !== "merge" ? role : viewer.includes("!stream:") ? "ego" : "fusion");
const who = (answer) =>
  answer.viewer.includes("~") && answer.role !== "merge" ? `${sender(answer)}, ${answer.role} helper`
    : `${heard(answer.viewer)}, ${roleWord(answer)}`;

const signed = (value) => `${value < 0 ? "−" : "+"}${number(Math.abs(value), 2)}`;

// What moved an answer or a policy, a bar for each thing left out; those that moved it most come first.
function moved(leftOut, said) {
  if (!leftOut?.length) return null;
  const row = ({ item, kind, action, instead, change, shift }) => [
    h("span", {}, `without ${item}: `,
      shift == null ? "no answer" : `${signed(change)} ${action}`,
      instead && instead !== action ? h("strong", {}, ` → ${instead}`) : null),
    h("span", { class: "track", title: `total variation ${number(shift, 2)}` },
      h("i", { style: `width: ${100 * (shift ?? 0)}%` })),
    h("small", {}, kind),
  ];
  return [h("small", {}, said), h("div", { class: "moved" }, leftOut.map(row))];
}

function answerSection(answer, detail, actions, meanings, leftOut) {
  const facts = [
    answer.detail,
    answer.finish_reason && answer.finish_reason !== "stop" ? `finish reason ${answer.finish_reason}` : null,
    answer.error ? `engine: ${answer.error}` : null,
    answer.prompt_tokens ? `${answer.prompt_tokens} tokens in` : null,
    answer.completion_tokens ? `${answer.completion_tokens} out` : null,
    answer.seconds ? number(answer.seconds, 3, "s") : null,
    answer.label_mass != null ? `${number(100 * answer.label_mass, 2, "%")} of the probability on the letters` : null,
    answer.retries ? `${answer.retries} failed attempts before` : null,
    answer.cached ? "from the cache" : null,
  ].filter(Boolean).join("; ");
  const sent = detail.prompts[answer.prompt];
  const message = Object.entries(answer.message ?? {});
  return h("section", { class: "answer" },
    h("h4", {}, [who(answer), answer.agent].filter(Boolean).join(", "), [...(answer.faults ?? [answer.status]), ...(answer.repairs ?? [])].map((word) =>
      [" ", h("span", { class: "tag", title: meanings[word] }, word)])),
    h("p", { class: "quiet" }, facts),
    h("div", { class: "pair" },
      h("div", {},
        h("small", {}, answer.spans.length ? "raw answer; marked: what was parsed" : "raw answer"),
        highlighted(answer.raw, answer.spans),
        answer.first_status ? [h("small", {}, `before the repair turn: ${answer.first_status}`), h("pre", {}, answer.first_raw)] : null),
      h("div", {},
        h("small", {}, "as parsed"), h("p", {}, distribution(actions, answer.intent)),
        answer.mass != null && Math.abs(answer.mass - 1) > 1e-3
          ? h("p", { class: "quiet" }, `the model's numbers sum to ${number(answer.mass, 3)}`) : null,
        message.length ? h("dl", {}, message.map(([name, text]) => [h("dt", {}, name), h("dd", {}, text)])) : null,
        moved(leftOut, "effect of leaving out one object of the prompt at a time"))),
    sent
      ? h("details", {},
        h("summary", {}, `prompt, ${sent.length} messages`),
        sent.map((m) => [h("small", {}, m.role), h("pre", {}, m.content)]))
      : answer.prompt == null && h("p", { class: "quiet" }, "prompt: its text is not available as it was sent"));
}
